//! Instruction-set dispatch: one kernel body, compiled once per instruction set.
//!
//! ```text
//! Isa::run(kernel):  AVX-512 → avx512(kernel)    the same inlined `Kernel::run`, with the vectors of `simd`
//!                    AVX2    → avx2(kernel)
//!                    dot product of bytes → dot(kernel)
//!                    NEON    → kernel.run(Plain)
//!                    else    → kernel.run(Portable)
//! ```
//!
//! Invariants:
//! - An [`Isa`] is the proof that its instructions exist: only its constructors make one, and only
//!   [`Isa::detect`] and [`Isa::all`] query the CPU.
//! - The bits of a result do not depend on the `Isa`. A wider register holds more of the sixteen lanes, and wider code sums more
//!   outputs side by side, but each sum has the same operations in the same order, and Rust never fuses a multiplication with an
//!   addition. `tests/twins.rs` compares every kernel bit for bit.
//!
//! Nothing here can fail: a CPU that offers nothing wider gets [`Isa::portable`].
#![allow(unsafe_code)]

use core::fmt;

use crate::simd::{Portable, Simd};

/// Instruction set that kernels may use, chosen once and then passed along; copying it costs
/// nothing.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Isa(Level);

/// Levels of instruction sets, sorted from narrow to wide.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Level {
    /// The baseline of the build's target.
    Portable,
    /// AVX, AVX2 and F16C.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// AVX, AVX2, F16C and AVX-512 F, BW, DQ, VL and VNNI: Cascade Lake, Zen 4 and later.
    #[cfg(target_arch = "x86_64")]
    Avx512,
    /// NEON, the baseline of aarch64, through its intrinsics.
    #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
    Neon,
    /// NEON with the dot product of bytes: Cortex-A55, A75 and later.
    #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
    Dot,
}

impl Isa {
    /// Returns the baseline instruction set, which every CPU of the build's target has. For tests,
    /// and where the machine code has to be the same on all machines.
    pub const fn portable() -> Self {
        Self(Level::Portable)
    }

    /// Returns the widest instruction set that this CPU and its operating system offer.
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        return Self(x86_64::widest());
        #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
        return Self(aarch64::widest());
        #[cfg(not(any(
            target_arch = "x86_64",
            all(target_arch = "aarch64", target_feature = "neon")
        )))]
        return Self::portable();
    }

    /// Returns all instruction sets that this CPU and its operating system offer, the portable one
    /// first.
    pub fn all() -> impl Iterator<Item = Self> {
        let widest = Self::detect();
        [
            Level::Portable,
            #[cfg(target_arch = "x86_64")]
            Level::Avx2,
            #[cfg(target_arch = "x86_64")]
            Level::Avx512,
            #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
            Level::Neon,
            #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
            Level::Dot,
        ]
        .into_iter()
        .map(Self)
        .filter(move |isa| *isa <= widest)
    }

    /// Returns the name of the instruction set: `portable`; on x86-64 also `avx2` and `avx512`, on
    /// aarch64 `neon` and `dotprod`.
    pub const fn name(self) -> &'static str {
        match self.0 {
            Level::Portable => "portable",
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => "avx2",
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => "avx512",
            #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
            Level::Neon => "neon",
            #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
            Level::Dot => "dotprod",
        }
    }

    /// Runs a kernel with this instruction set.
    #[inline(always)]
    pub(crate) fn run<K: Kernel>(self, kernel: K) {
        match self.0 {
            Level::Portable => kernel.run(Portable),
            #[cfg(target_arch = "x86_64")]
            // SAFETY: `Isa`'s constructors make this level only where `x86_64::widest` found AVX2 and F16C in CPU
            // and operating system.
            Level::Avx2 => unsafe { x86_64::avx2(kernel) },
            #[cfg(target_arch = "x86_64")]
            // SAFETY: as below; AVX2 and F16C are a part of that level.
            Level::Avx512 if K::BRIEF => unsafe { x86_64::avx2(kernel) },
            #[cfg(target_arch = "x86_64")]
            // SAFETY: `Isa`'s constructors make this level only where `x86_64::widest` found AVX2, F16C and all five
            // parts of AVX-512 in CPU and operating system.
            Level::Avx512 => unsafe { x86_64::avx512(kernel) },
            #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
            Level::Neon => kernel.run(crate::simd::aarch64::Plain::new()),
            #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
            // SAFETY: `Isa`'s constructors make this level only where `aarch64::widest` found the dot product.
            Level::Dot => unsafe { aarch64::dot(kernel) },
        }
    }
}

impl fmt::Debug for Isa {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "Isa({})", self.name())
    }
}

/// A kernel and its operands.
pub(crate) trait Kernel {
    /// True if AVX-512 runs the kernel on vectors of half the width, because its time goes into
    /// conversions, which wide vectors do not shorten.
    #[cfg_attr(
        not(target_arch = "x86_64"),
        allow(dead_code, reason = "only AVX-512 asks")
    )]
    const NARROW: bool = false;

    /// True if AVX-512 runs the body that AVX2 has, because the kernel takes too little of a step to
    /// pay for code of its own.
    #[cfg_attr(
        not(target_arch = "x86_64"),
        allow(dead_code, reason = "only AVX-512 asks")
    )]
    const BRIEF: bool = false;

    /// Runs the kernel with the vectors of `simd`. Every implementation, and every function that it
    /// calls, is `#[inline(always)]`, so that each instruction set gets a body of its own.
    fn run<S: Simd>(self, simd: S);
}

#[cfg(target_arch = "x86_64")]
mod x86_64 {
    use core::arch::x86_64::{__cpuid_count, _xgetbv, CpuidResult};

    use super::{Kernel, Level};
    use crate::simd::x86_64::{Avx2, Avx512, Avx512Narrow};

    /// Runs a kernel compiled for AVX2 and F16C.
    ///
    /// # Safety
    /// The CPU and the operating system offer AVX2 and F16C.
    #[target_feature(enable = "avx2,f16c")]
    pub unsafe fn avx2(kernel: impl Kernel) {
        // SAFETY: the caller's promise is this constructor's.
        kernel.run(unsafe { Avx2::new() });
    }

    /// Runs a kernel compiled for AVX-512.
    ///
    /// # Safety
    /// The CPU and the operating system offer AVX2, F16C and the five parts of AVX-512.
    #[target_feature(enable = "avx2,f16c,avx512f,avx512bw,avx512dq,avx512vl,avx512vnni")]
    pub unsafe fn avx512<K: Kernel>(kernel: K) {
        // SAFETY: the caller's promise is these constructors'.
        unsafe {
            if K::NARROW {
                kernel.run(Avx512Narrow::new());
            } else {
                kernel.run(Avx512::new());
            }
        }
    }

    /// Bits of XCR0, the register states that the operating system saves: SSE and AVX.
    const YMM_STATE: u64 = 0b110;
    /// Bits of XCR0 for AVX-512: SSE, AVX, the mask registers, the upper halves of the first sixteen ZMM registers, the other sixteen.
    const ZMM_STATE: u64 = 0b1110_0110;

    /// Returns the registers of a leaf of CPUID.
    #[allow(
        unused_unsafe,
        reason = "a safe function in newer versions of Rust than our `rust-version`"
    )]
    fn cpuid(leaf: u32) -> CpuidResult {
        // SAFETY: every x86-64 CPU has the instruction.
        unsafe { __cpuid_count(leaf, 0) }
    }

    /// Queries the CPU for the widest level. Bits and leaves are from Intel's manual, volume 1,
    /// sections 14.3, 14.7.1 and 15.2.
    pub fn widest() -> Level {
        let has = |register: u32, bits: &[u32]| bits.iter().all(|bit| register >> bit & 1 == 1);
        if cpuid(0).eax < 7 {
            return Level::Portable;
        }
        // Leaf 1, ECX: 27 OSXSAVE, 28 AVX, 29 F16C.
        if !has(cpuid(1).ecx, &[27, 28, 29]) {
            return Level::Portable;
        }
        // SAFETY: OSXSAVE, read from the CPU above, says that the operating system has enabled `xgetbv`.
        let saved = unsafe { _xgetbv(0) };
        // Leaf 7, EBX: 5 AVX2, 16 AVX512F, 17 AVX512DQ, 30 AVX512BW, 31 AVX512VL; ECX: 11 AVX512_VNNI.
        let extended = cpuid(7);
        let avx2 = has(extended.ebx, &[5]) && saved & YMM_STATE == YMM_STATE;
        let avx512 = has(extended.ebx, &[16, 17, 30, 31])
            && has(extended.ecx, &[11])
            && saved & ZMM_STATE == ZMM_STATE;
        match (avx2, avx512) {
            (true, true) => Level::Avx512,
            (true, false) => Level::Avx2,
            (false, _) => Level::Portable,
        }
    }
}

#[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
mod aarch64 {
    use super::{Kernel, Level};
    use crate::simd::aarch64::Dot;

    /// Runs a kernel compiled for the dot product of bytes.
    ///
    /// # Safety
    /// The CPU has FEAT_DotProd.
    #[target_feature(enable = "dotprod")]
    pub unsafe fn dot(kernel: impl Kernel) {
        // SAFETY: the caller's promise is this constructor's.
        kernel.run(unsafe { Dot::new() });
    }

    pub fn widest() -> Level {
        if has_dot_product() {
            Level::Dot
        } else {
            Level::Neon
        }
    }

    /// Asks the operating system whether the CPU has the dot product of bytes. User code cannot
    /// read the CPU's own registers, so elsewhere the build has to state it
    /// (`-C target-feature=+dotprod`, as Apple's targets do).
    fn has_dot_product() -> bool {
        #[cfg(any(target_os = "linux", target_os = "android"))]
        let said = {
            use core::ffi::c_ulong;
            // In every C library of Linux, which programs with Rust's standard library and those in C have.
            unsafe extern "C" {
                safe fn getauxval(kind: c_ulong) -> c_ulong;
            }
            const AT_HWCAP: c_ulong = 16;
            const HWCAP_ASIMDDP: c_ulong = 1 << 20;
            getauxval(AT_HWCAP) & HWCAP_ASIMDDP != 0
        };
        #[cfg(not(any(target_os = "linux", target_os = "android")))]
        let said = false;
        said || cfg!(target_feature = "dotprod")
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use super::Isa;

    #[test]
    fn the_portable_one_comes_first_and_the_detected_one_last() {
        assert_eq!(Isa::all().next(), Some(Isa::portable()));
        assert_eq!(Isa::all().last(), Some(Isa::detect()));
        assert!(Isa::all().is_sorted());
    }

    /// Compares the detection with the standard library's independent implementation.
    #[cfg(target_arch = "x86_64")]
    #[test]
    fn detection_agrees_with_the_standard_library() {
        let avx2 = std::arch::is_x86_feature_detected!("avx2")
            && std::arch::is_x86_feature_detected!("f16c");
        let avx512 = avx2
            && std::arch::is_x86_feature_detected!("avx512f")
            && std::arch::is_x86_feature_detected!("avx512bw")
            && std::arch::is_x86_feature_detected!("avx512dq")
            && std::arch::is_x86_feature_detected!("avx512vl")
            && std::arch::is_x86_feature_detected!("avx512vnni");
        let expected = match (avx2, avx512) {
            (_, true) => "avx512",
            (true, _) => "avx2",
            _ => "portable",
        };
        assert_eq!(Isa::detect().name(), expected);
    }

    /// Compares the detection with the standard library's independent implementation.
    #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
    #[test]
    fn detection_agrees_with_the_standard_library() {
        let dot = std::arch::is_aarch64_feature_detected!("dotprod");
        let expected = if dot { "dotprod" } else { "neon" };
        assert_eq!(Isa::detect().name(), expected);
    }
}
