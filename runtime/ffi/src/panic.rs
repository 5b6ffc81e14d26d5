//! Panic handler of the static library, which is unreachable.
//!
//! Core, kernels and this crate have no panic that the optimised build keeps. The handler, which
//! Rust requires nevertheless, refers to an undefined symbol: if a panic were reachable, linking
//! the archive would fail, and building it does (`runtime/ffi/archive.sh` drops unreachable code
//! and then looks for the symbol).

use core::panic::PanicInfo;

unsafe extern "C" {
    /// Undefined symbol, so that a reachable panic fails to link.
    fn lads_a_panic_is_reachable() -> !;
}

#[panic_handler]
fn panic(_: &PanicInfo) -> ! {
    // SAFETY: a program with this call in it does not link.
    unsafe { lads_a_panic_is_reachable() }
}

/// Symbol to which the precompiled `core` refers on hosted targets, where it was built to unwind.
/// It is never called: panics abort.
#[cfg(not(target_os = "none"))]
#[unsafe(no_mangle)]
pub extern "C" fn rust_eh_personality() {}
