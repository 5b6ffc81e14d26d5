//! Treats subnormal numbers as zero while a program runs.
//!
//! Some processors need a hundred cycles and more for an operation on a number below the normal
//! range, which a controller would feel as jitter that depends on the data. On x86-64 the two bits
//! of MXCSR that replace such operands and results by zero are set for the time of a run and
//! restored afterwards. All instruction sets of a processor share the mode, so results still have
//! the same bits on all of them. On other targets nothing happens: a program that meets subnormal
//! numbers may give other bits there. Arm's mode would not close that gap, because it decides
//! before rounding what is too small, and x86-64 after.
//!
//! Invariants:
//! - The mode ends when [`flushed`] ends, also by a panic. The guard that restores the register
//!   never leaves this module, so no caller can forget it, move it or drop two of them out of
//!   order.
//! - Each thread has a register of its own. Linux gives a new thread its creator's mode, so code
//!   that runs here must not start threads.
//! - Rust gives no promise about floating-point arithmetic under another MXCSR; compilers compute
//!   constants, and move arithmetic, as if subnormal numbers were exact. The switches therefore are
//!   assembly that may read and write any memory: loads after the first and stores before the
//!   second are computed between them, which covers all that a program does with its arena. A
//!   constant that a compiler computes is what it would be without this mode.
//!
//! Nothing here can fail.
#![allow(unsafe_code)]

/// Runs `work` with subnormal numbers taken as zero on this thread, and returns its result.
///
/// The processor's previous mode is restored afterwards, also if `work` panics. The function takes
/// a closure because safe code could forget a guard.
#[inline(always)]
pub fn flushed<T>(work: impl FnOnce() -> T) -> T {
    let _restored = Mode::flush();
    work()
}

/// Flush-to-zero for results (bit 15) and denormals-are-zeros for operands (bit 6): Intel's manual, volume 1, section 10.2.3.
#[cfg(target_arch = "x86_64")]
const FLUSH: u32 = 1 << 15 | 1 << 6;

/// Guard that restores the previous mode when it is dropped.
struct Mode {
    #[cfg(target_arch = "x86_64")]
    before: u32,
}

impl Mode {
    #[inline(always)]
    fn flush() -> Self {
        #[cfg(target_arch = "x86_64")]
        let before = x86_64::mode();
        #[cfg(target_arch = "x86_64")]
        x86_64::set_mode(before | FLUSH);
        Self {
            #[cfg(target_arch = "x86_64")]
            before,
        }
    }
}

impl Drop for Mode {
    #[inline(always)]
    fn drop(&mut self) {
        #[cfg(target_arch = "x86_64")]
        x86_64::set_mode(self.before);
    }
}

#[cfg(target_arch = "x86_64")]
mod x86_64 {
    use core::arch::asm;

    /// Reads MXCSR.
    #[inline(always)]
    pub fn mode() -> u32 {
        let mut mode = 0_u32;
        // SAFETY: stores the register to a word that lives here; it is part of SSE, which every x86-64 CPU has.
        unsafe { asm!("stmxcsr [{}]", in(reg) &raw mut mode, options(nostack, preserves_flags)) };
        mode
    }

    /// Sets MXCSR to a value that `mode` returned, with or without `FLUSH`.
    #[inline(always)]
    pub fn set_mode(mode: u32) {
        // SAFETY: the value has no reserved bit, because it was read from the register but for two bits that every x86-64 CPU has.
        // Rounding and the masks of exceptions stay as Rust wants them. Neither `readonly` nor `nomem`: loads and stores, and so
        // the arithmetic between them, stay on their side of the switch, as the head of this module explains.
        unsafe {
            // Not `preserves_flags`, which takes in the register's sticky flags of exceptions.
            asm!("ldmxcsr [{}]", in(reg) &raw const mode, options(nostack));
        }
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use core::hint::black_box;

    use super::flushed;

    /// Computes half of the smallest normal number at run time.
    fn halved() -> f32 {
        black_box(black_box(f32::MIN_POSITIVE) * black_box(0.5))
    }

    /// Returns whether subnormal operands are currently taken as zero.
    fn is_flushed() -> bool {
        black_box(black_box(f32::from_bits(1)) * black_box(1e20)).to_bits() == 0
    }

    #[test]
    fn subnormal_numbers_are_zero_and_come_back() {
        assert!(halved() > 0.0 && !is_flushed());
        let inside = flushed(|| {
            let inner = flushed(|| (halved().to_bits(), is_flushed()));
            // The end of the inner one does not end the outer one.
            assert_eq!(inner, (halved().to_bits(), is_flushed()));
            inner
        });
        if cfg!(target_arch = "x86_64") {
            assert_eq!(inside, (0, true));
        }
        assert!(halved() > 0.0 && !is_flushed());
    }

    #[test]
    fn the_mode_ends_with_an_early_return() {
        let work = |x: Option<f32>| flushed(|| Some(x? * 2.0));
        assert_eq!(work(None), None);
        assert!(halved() > 0.0 && !is_flushed());
        assert_eq!(work(Some(1.5)), Some(3.0));
        assert!(halved() > 0.0 && !is_flushed());
    }

    #[test]
    fn the_mode_ends_with_a_panic_and_subnormal_numbers_are_zero_until_then() {
        let mut seen = false;
        let panicked = std::panic::catch_unwind(core::panic::AssertUnwindSafe(|| {
            flushed(|| {
                flushed(|| seen = is_flushed());
                // No message on the console.
                std::panic::resume_unwind(std::boxed::Box::new(()));
            });
        }));
        assert!(panicked.is_err());
        assert_eq!(seen, cfg!(target_arch = "x86_64"));
        assert!(halved() > 0.0 && !is_flushed());
        // A thread that starts now inherits no mode either.
        assert!(
            !std::thread::spawn(is_flushed)
                .join()
                .expect("it ran to its end")
        );
    }
}
