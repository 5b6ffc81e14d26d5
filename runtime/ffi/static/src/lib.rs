//! The static library for C: [`lads_ffi`], and the panic handler that Rust requires of a library without std.
//!
//! A crate of its own, because link-time optimisation runs at the level of the last crate: that has to be 3, so that the kernels' loops are
//! vectorised, while the boundary's own code is to be small. `runtime/ffi/archive.sh` builds it, with feature `archive`.
//!
//! Core, kernels and lads-ffi have no panic that the optimised build keeps. The handler refers to an undefined symbol: if a panic were
//! reachable, linking the archive would fail, and building it does (`archive.sh` drops unreachable code and then looks for the symbol).
#![no_std]

/// What the library exports.
pub use lads_ffi;

#[cfg(feature = "archive")]
mod panic {
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
}
