//! The panic handler of the static library, which nothing reaches.
//!
//! Core, kernels and this crate have no panic that the optimised build keeps. The handler that Rust asks for all the same refers
//! to a symbol that nobody defines: where a panic could be reached, linking the archive would fail, and building it does
//! (`runtime/ffi/archive.sh` drops what is not reachable and then looks for the symbol).

use core::panic::PanicInfo;

unsafe extern "C" {
    /// Does not exist.
    fn lads_a_panic_is_reachable() -> !;
}

#[panic_handler]
fn panic(_: &PanicInfo) -> ! {
    // SAFETY: a program with this call in it does not link.
    unsafe { lads_a_panic_is_reachable() }
}

/// The precompiled `core` refers to this symbol on hosted targets, where it was built to unwind. Nothing calls it: panics abort.
#[cfg(not(target_os = "none"))]
#[unsafe(no_mangle)]
pub extern "C" fn rust_eh_personality() {}
