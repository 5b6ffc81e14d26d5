//! The panic handler of the static library.
//!
//! The runtime has no code that panics on purpose, and what the compiler leaves of bounds checks is not reachable with checked
//! images; but a library without `std` has to say what a panic does. It calls `lads_panic`, which the integrator defines:
//! stop the motors and do not return.

use core::panic::PanicInfo;

unsafe extern "C" {
    /// Defined by the integrator: bring the machine to a safe state, never return.
    fn lads_panic() -> !;
}

#[panic_handler]
fn panic(_: &PanicInfo) -> ! {
    // SAFETY: the integrator guarantees a function of this name and signature that never returns.
    unsafe { lads_panic() }
}

/// The precompiled `core` refers to this symbol on hosted targets, where it was built to unwind. Nothing calls it: panics abort.
#[cfg(not(target_os = "none"))]
#[unsafe(no_mangle)]
pub extern "C" fn rust_eh_personality() {}
