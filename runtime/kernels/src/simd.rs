//! Vectors of sixteen lanes, one implementation per instruction set; the bits of every operation are those of [`Portable`].
//!
//! Loops that compilers vectorise by themselves are written over arrays; the loops in which a control step spends its time, over
//! weights and over the KV cache, are written with these vectors, so that what they compile to does not depend on the
//! compiler's mood.
//!
//! Invariant: a value that implements [`Simd`] is the proof that its instructions exist. Those of an instruction set that the
//! target does not have in any case are made by `dispatch` alone, inside a function that is compiled for them.
#![allow(unsafe_code)]

use crate::lanes::{Block, LANES};
use crate::stored;

/// An instruction set's vectors.
pub(crate) trait Simd: Copy {
    /// Sixteen lanes.
    type V: Copy;

    /// How many sums of sixteen lanes stay in registers, beside the operands.
    const SUMS: usize;

    /// The same number in every lane.
    fn splat(self, x: f32) -> Self::V;
    /// Sixteen numbers of memory.
    fn load(self, from: &Block) -> Self::V;
    /// Back to memory.
    fn store(self, v: Self::V, to: &mut Block);
    /// `a + b`
    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    /// `other` in the lanes where `x < 0`, else `x`.
    fn where_negative(self, x: Self::V, other: Self::V) -> Self::V;
    /// `a * b`
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    /// `sum + a * b`, rounded twice: never fused.
    fn add_product(self, sum: Self::V, a: Self::V, b: Self::V) -> Self::V;
    /// Sixteen half-precision numbers, [`stored::from_f16`].
    fn load_f16(self, from: &[u16; LANES]) -> Self::V;
    /// Sixteen numbers as half-precision ones, [`stored::round_to_f16`].
    fn round_to_f16(self, v: Self::V) -> [u16; LANES];
    /// Sixteen brain floats, [`stored::from_bf16`].
    fn load_bf16(self, from: &[u16; LANES]) -> Self::V;
    /// Sixteen integers.
    fn load_i8(self, from: &[i8; LANES]) -> Self::V;
}

/// Asks for the cache line at an address, where the target has an instruction for it. A hint: nothing need be there.
#[inline(always)]
pub(crate) fn prefetch<T>(at: *const T) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: part of SSE, which every x86-64 CPU has; it reads nothing.
    unsafe {
        use core::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T0>(at.cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = at;
}

/// What the build's target has in any case: arrays, which compilers put into its registers.
#[derive(Clone, Copy)]
pub(crate) struct Portable;

impl Simd for Portable {
    type V = Block;

    const SUMS: usize = 2;

    #[inline(always)]
    fn splat(self, x: f32) -> Block {
        [x; LANES]
    }

    #[inline(always)]
    fn load(self, from: &Block) -> Block {
        *from
    }

    #[inline(always)]
    fn store(self, v: Block, to: &mut Block) {
        *to = v;
    }

    #[inline(always)]
    fn add(self, mut a: Block, b: Block) -> Block {
        for (a, b) in a.iter_mut().zip(b) {
            *a += b;
        }
        a
    }

    #[inline(always)]
    fn where_negative(self, mut x: Block, other: Block) -> Block {
        for (x, other) in x.iter_mut().zip(other) {
            *x = if *x < 0.0 { other } else { *x };
        }
        x
    }

    #[inline(always)]
    fn mul(self, mut a: Block, b: Block) -> Block {
        for (a, b) in a.iter_mut().zip(b) {
            *a *= b;
        }
        a
    }

    #[inline(always)]
    fn add_product(self, mut sum: Block, a: Block, b: Block) -> Block {
        for (sum, (a, b)) in sum.iter_mut().zip(a.into_iter().zip(b)) {
            *sum += a * b;
        }
        sum
    }

    #[inline(always)]
    fn load_f16(self, from: &[u16; LANES]) -> Block {
        from.map(stored::from_f16)
    }

    #[inline(always)]
    fn round_to_f16(self, v: Block) -> [u16; LANES] {
        stored::round_all_to_f16(&v)
    }

    #[inline(always)]
    fn load_bf16(self, from: &[u16; LANES]) -> Block {
        from.map(stored::from_bf16)
    }

    #[inline(always)]
    fn load_i8(self, from: &[i8; LANES]) -> Block {
        from.map(f32::from)
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) mod x86_64 {
    use core::arch::x86_64::{
        __m256, __m512, _CMP_LT_OQ, _MM_FROUND_TO_NEAREST_INT, _mm_loadl_epi64, _mm_loadu_si128,
        _mm_storeu_si128, _mm256_add_ps, _mm256_blendv_ps, _mm256_castsi256_ps, _mm256_cmp_ps,
        _mm256_cvtepi8_epi32, _mm256_cvtepi32_ps, _mm256_cvtepu16_epi32, _mm256_cvtph_ps,
        _mm256_cvtps_ph, _mm256_loadu_ps, _mm256_loadu_si256, _mm256_mul_ps, _mm256_set1_ps,
        _mm256_setzero_ps, _mm256_slli_epi32, _mm256_storeu_ps, _mm256_storeu_si256, _mm512_add_ps,
        _mm512_castsi512_ps, _mm512_cmp_ps_mask, _mm512_cvtepi8_epi32, _mm512_cvtepi32_ps,
        _mm512_cvtepu16_epi32, _mm512_cvtph_ps, _mm512_cvtps_ph, _mm512_loadu_ps,
        _mm512_mask_blend_ps, _mm512_mul_ps, _mm512_set1_ps, _mm512_setzero_ps, _mm512_slli_epi32,
        _mm512_storeu_ps,
    };

    use super::Simd;
    use crate::lanes::{Block, LANES};

    /// A block in two registers. `NARROW` is whether AVX-512 doubles their number.
    #[derive(Clone, Copy)]
    pub(crate) struct Halves<const NARROW: bool>(());

    /// AVX2 with F16C: sixteen registers of half a block.
    pub(crate) type Avx2 = Halves<false>;
    /// The same on AVX-512: thirty-two registers of half a block.
    pub(crate) type Avx512Narrow = Halves<true>;
    /// AVX-512: thirty-two registers of a block.
    #[derive(Clone, Copy)]
    pub(crate) struct Avx512(());

    impl<const NARROW: bool> Halves<NARROW> {
        /// # Safety
        /// The CPU and the operating system offer AVX2 and F16C, and AVX-512 VL where `NARROW`.
        #[inline(always)]
        pub(crate) unsafe fn new() -> Self {
            Self(())
        }
    }

    impl Avx512 {
        /// # Safety
        /// The CPU and the operating system offer AVX-512 F, BW, DQ and VL.
        #[inline(always)]
        pub(crate) unsafe fn new() -> Self {
            Self(())
        }
    }

    impl<const NARROW: bool> Simd for Halves<NARROW> {
        type V = [__m256; 2];

        const SUMS: usize = if NARROW { 8 } else { 4 };

        #[inline(always)]
        fn splat(self, x: f32) -> Self::V {
            // SAFETY: whoever made `self` has AVX2.
            [unsafe { _mm256_set1_ps(x) }; 2]
        }

        #[inline(always)]
        fn load(self, from: &Block) -> Self::V {
            let from = from.as_ptr();
            // SAFETY: whoever made `self` has AVX2; both halves lie inside the block.
            unsafe { [_mm256_loadu_ps(from), _mm256_loadu_ps(from.add(8))] }
        }

        #[inline(always)]
        fn store(self, [low, high]: Self::V, to: &mut Block) {
            let to = to.as_mut_ptr();
            // SAFETY: whoever made `self` has AVX2; both halves lie inside the block.
            unsafe {
                _mm256_storeu_ps(to, low);
                _mm256_storeu_ps(to.add(8), high);
            }
        }

        #[inline(always)]
        fn add(self, a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: whoever made `self` has AVX2.
            unsafe { [_mm256_add_ps(a[0], b[0]), _mm256_add_ps(a[1], b[1])] }
        }

        #[inline(always)]
        fn where_negative(self, [low, high]: Self::V, other: Self::V) -> Self::V {
            // SAFETY: whoever made `self` has AVX2.
            unsafe {
                let zero = _mm256_setzero_ps();
                let negative = |x| _mm256_cmp_ps::<_CMP_LT_OQ>(x, zero);
                [
                    _mm256_blendv_ps(low, other[0], negative(low)),
                    _mm256_blendv_ps(high, other[1], negative(high)),
                ]
            }
        }

        #[inline(always)]
        fn mul(self, a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: whoever made `self` has AVX2.
            unsafe { [_mm256_mul_ps(a[0], b[0]), _mm256_mul_ps(a[1], b[1])] }
        }

        #[inline(always)]
        fn add_product(self, sum: Self::V, a: Self::V, b: Self::V) -> Self::V {
            self.add(sum, self.mul(a, b))
        }

        #[inline(always)]
        fn load_f16(self, from: &[u16; LANES]) -> Self::V {
            let from = from.as_ptr();
            // SAFETY: whoever made `self` has AVX2 and F16C; both halves lie inside the block.
            unsafe {
                [
                    _mm256_cvtph_ps(_mm_loadu_si128(from.cast())),
                    _mm256_cvtph_ps(_mm_loadu_si128(from.add(8).cast())),
                ]
            }
        }

        #[inline(always)]
        fn round_to_f16(self, v: Self::V) -> [u16; LANES] {
            let mut to = [0; LANES];
            let at: *mut u16 = to.as_mut_ptr();
            // SAFETY: whoever made `self` has AVX2 and F16C; both halves lie inside the block.
            unsafe {
                let [low, high] = v.map(|v| _mm256_cvtps_ph::<_MM_FROUND_TO_NEAREST_INT>(v));
                _mm_storeu_si128(at.cast(), low);
                _mm_storeu_si128(at.add(8).cast(), high);
            }
            to
        }

        #[inline(always)]
        fn load_bf16(self, from: &[u16; LANES]) -> Self::V {
            let from = from.as_ptr();
            // SAFETY: whoever made `self` has AVX2; both halves lie inside the block.
            unsafe {
                [from, from.add(8)].map(|from| {
                    let words = _mm256_cvtepu16_epi32(_mm_loadu_si128(from.cast()));
                    _mm256_castsi256_ps(_mm256_slli_epi32::<16>(words))
                })
            }
        }

        #[inline(always)]
        fn load_i8(self, from: &[i8; LANES]) -> Self::V {
            let from = from.as_ptr();
            // SAFETY: whoever made `self` has AVX2; both halves, of eight bytes each, lie inside the block.
            unsafe {
                [from, from.add(8)].map(|from| {
                    _mm256_cvtepi32_ps(_mm256_cvtepi8_epi32(_mm_loadl_epi64(from.cast())))
                })
            }
        }
    }

    impl Simd for Avx512 {
        type V = __m512;

        const SUMS: usize = 16;

        #[inline(always)]
        fn splat(self, x: f32) -> Self::V {
            // SAFETY: whoever made `self` has AVX-512.
            unsafe { _mm512_set1_ps(x) }
        }

        #[inline(always)]
        fn load(self, from: &Block) -> Self::V {
            // SAFETY: whoever made `self` has AVX-512; a block is sixteen numbers.
            unsafe { _mm512_loadu_ps(from.as_ptr()) }
        }

        #[inline(always)]
        fn store(self, v: Self::V, to: &mut Block) {
            // SAFETY: whoever made `self` has AVX-512; a block is sixteen numbers.
            unsafe { _mm512_storeu_ps(to.as_mut_ptr(), v) }
        }

        #[inline(always)]
        fn add(self, a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: whoever made `self` has AVX-512.
            unsafe { _mm512_add_ps(a, b) }
        }

        #[inline(always)]
        fn where_negative(self, x: Self::V, other: Self::V) -> Self::V {
            // SAFETY: whoever made `self` has AVX-512.
            unsafe {
                let negative = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(x, _mm512_setzero_ps());
                _mm512_mask_blend_ps(negative, x, other)
            }
        }

        #[inline(always)]
        fn mul(self, a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: whoever made `self` has AVX-512.
            unsafe { _mm512_mul_ps(a, b) }
        }

        #[inline(always)]
        fn add_product(self, sum: Self::V, a: Self::V, b: Self::V) -> Self::V {
            self.add(sum, self.mul(a, b))
        }

        #[inline(always)]
        fn load_f16(self, from: &[u16; LANES]) -> Self::V {
            // SAFETY: whoever made `self` has AVX-512; a block is sixteen numbers.
            unsafe { _mm512_cvtph_ps(_mm256_loadu_si256(from.as_ptr().cast())) }
        }

        #[inline(always)]
        fn round_to_f16(self, v: Self::V) -> [u16; LANES] {
            let mut to = [0; LANES];
            // SAFETY: whoever made `self` has AVX-512; a block is sixteen numbers.
            unsafe {
                let halves = _mm512_cvtps_ph::<_MM_FROUND_TO_NEAREST_INT>(v);
                _mm256_storeu_si256(to.as_mut_ptr().cast(), halves);
            }
            to
        }

        #[inline(always)]
        fn load_bf16(self, from: &[u16; LANES]) -> Self::V {
            // SAFETY: whoever made `self` has AVX-512; a block is sixteen numbers.
            unsafe {
                let words = _mm512_cvtepu16_epi32(_mm256_loadu_si256(from.as_ptr().cast()));
                _mm512_castsi512_ps(_mm512_slli_epi32::<16>(words))
            }
        }

        #[inline(always)]
        fn load_i8(self, from: &[i8; LANES]) -> Self::V {
            // SAFETY: whoever made `self` has AVX-512; a block is sixteen bytes.
            unsafe {
                _mm512_cvtepi32_ps(_mm512_cvtepi8_epi32(_mm_loadu_si128(from.as_ptr().cast())))
            }
        }
    }
}
