//! Subnormal numbers taken as zero while a program runs.
//!
//! Some processors need a hundred cycles and more for an operation on a number below the normal range, which a controller would
//! feel as jitter that depends on the data. On x86-64 the two bits of MXCSR that replace such operands and results by zero are set
//! for the time of a run and what was there comes back afterwards; elsewhere nothing happens. All instruction sets of a processor
//! share the mode, so results still have the same bits on all of them. Nothing here can fail.
#![allow(unsafe_code)]

/// While it lives, subnormal numbers are zero on this thread.
#[derive(Debug)]
#[must_use = "the mode ends where this is dropped"]
pub struct Flushed {
    #[cfg(target_arch = "x86_64")]
    before: u32,
    /// The mode belongs to a thread, so this stays on it.
    thread: core::marker::PhantomData<*const ()>,
}

/// Flush-to-zero for results (bit 15) and denormals-are-zeros for operands (bit 6): Intel's manual, volume 1, section 10.2.3.
#[cfg(target_arch = "x86_64")]
const FLUSH: u32 = 1 << 15 | 1 << 6;

impl Flushed {
    /// Sets the mode.
    #[inline]
    pub fn new() -> Self {
        #[cfg(target_arch = "x86_64")]
        let before = x86_64::mode();
        #[cfg(target_arch = "x86_64")]
        x86_64::set_mode(before | FLUSH);
        Self {
            #[cfg(target_arch = "x86_64")]
            before,
            thread: core::marker::PhantomData,
        }
    }
}

impl Default for Flushed {
    fn default() -> Self {
        Self::new()
    }
}

impl Drop for Flushed {
    #[inline]
    fn drop(&mut self) {
        #[cfg(target_arch = "x86_64")]
        x86_64::set_mode(self.before);
    }
}

#[cfg(target_arch = "x86_64")]
mod x86_64 {
    use core::arch::asm;

    /// MXCSR.
    #[inline]
    pub fn mode() -> u32 {
        let mut mode = 0_u32;
        // SAFETY: stores the register to a word that lives here; it is part of SSE, which every x86-64 CPU has.
        unsafe { asm!("stmxcsr [{}]", in(reg) &raw mut mode, options(nostack, preserves_flags)) };
        mode
    }

    /// Sets MXCSR to what `mode` gave, with or without `FLUSH`.
    #[inline]
    pub fn set_mode(mode: u32) {
        // SAFETY: the value has no reserved bit, because it was read from the register but for two bits that every x86-64 CPU has.
        // Rounding and the masks of exceptions stay as Rust wants them. Compilers take subnormal numbers to be exact when they
        // compute constants; that such a constant is not flushed is what a program without this mode would see.
        unsafe {
            asm!("ldmxcsr [{}]", in(reg) &raw const mode, options(nostack, readonly, preserves_flags));
        }
    }
}

#[cfg(test)]
mod tests {
    use core::hint::black_box;

    use super::Flushed;

    #[test]
    fn subnormal_numbers_are_zero_and_come_back() {
        let (smallest, half) = (black_box(f32::MIN_POSITIVE), black_box(0.5_f32));
        let halved = || black_box(black_box(smallest) * black_box(half));
        assert!(halved() > 0.0);
        {
            let _outer = Flushed::new();
            {
                let _inner = Flushed::default();
            }
            if cfg!(target_arch = "x86_64") {
                assert_eq!(halved().to_bits(), 0);
                let subnormal = black_box(f32::from_bits(1));
                assert_eq!((black_box(subnormal) * black_box(1e20)).to_bits(), 0);
            }
        }
        assert!(halved() > 0.0);
    }
}
