//! Vectors of x86-64: AVX2 with F16C, and AVX-512, whole or as twice as many AVX2 registers; and the one operation for which arrays
//! need the baseline's instruction by name.
//!
//! Invariant: `dispatch` alone makes these values, inside a function that is compiled for their instructions.

use core::arch::x86_64::{
    __m256, __m256i, __m512, __m512i, _CMP_LT_OQ, _MM_FROUND_TO_NEAREST_INT, _mm_add_epi32,
    _mm_cvtsi128_si32, _mm_loadl_epi64, _mm_loadu_si128, _mm_madd_epi16, _mm_max_epi32,
    _mm_shuffle_epi32, _mm_storeu_si128, _mm256_add_epi32, _mm256_add_ps, _mm256_and_si256,
    _mm256_blendv_ps, _mm256_castps_si256, _mm256_castsi256_ps, _mm256_castsi256_si128,
    _mm256_cmp_ps, _mm256_cvtepi8_epi16, _mm256_cvtepi8_epi32, _mm256_cvtepi32_ps,
    _mm256_cvtepu16_epi32, _mm256_cvtph_ps, _mm256_cvtps_ph, _mm256_extracti128_si256,
    _mm256_loadu_ps, _mm256_loadu_si256, _mm256_madd_epi16, _mm256_max_epi32, _mm256_min_ps,
    _mm256_mul_ps, _mm256_packs_epi32, _mm256_permute4x64_epi64, _mm256_set1_epi32, _mm256_set1_ps,
    _mm256_setzero_ps, _mm256_setzero_si256, _mm256_slli_epi32, _mm256_srai_epi32,
    _mm256_storeu_ps, _mm256_storeu_si256, _mm512_add_epi32, _mm512_add_ps, _mm512_and_si512,
    _mm512_castps_si512, _mm512_castsi512_ps, _mm512_cmp_ps_mask, _mm512_cvtepi8_epi32,
    _mm512_cvtepi32_epi16, _mm512_cvtepi32_ps, _mm512_cvtepu16_epi32, _mm512_cvtph_ps,
    _mm512_cvtps_ph, _mm512_dpwssd_epi32, _mm512_loadu_ps, _mm512_loadu_si512,
    _mm512_mask_blend_ps, _mm512_max_epi32, _mm512_min_ps, _mm512_mul_ps, _mm512_reduce_max_epi32,
    _mm512_set1_epi32, _mm512_set1_ps, _mm512_setzero_ps, _mm512_setzero_si512, _mm512_slli_epi32,
    _mm512_storeu_ps,
};

use core::arch::asm;

use super::{MAGNITUDE, ROUND, Simd};
use crate::lanes::{Block, LANES};

/// A block in two registers. `NARROW` is true if AVX-512 doubles the number of registers.
#[derive(Clone, Copy)]
pub(crate) struct Halves<const NARROW: bool>(());

/// AVX2 with F16C: sixteen registers of half a block.
pub(crate) type Avx2 = Halves<false>;
/// AVX-512 in registers of half a block, of which it has thirty-two.
pub(crate) type Avx512Narrow = Halves<true>;
/// AVX-512: thirty-two registers of a block.
#[derive(Clone, Copy)]
pub(crate) struct Avx512(());

impl<const NARROW: bool> Halves<NARROW> {
    /// Makes the value that proves these instructions.
    ///
    /// # Safety
    /// The CPU and the operating system offer AVX2 and F16C, and AVX-512 VL where `NARROW`.
    #[inline(always)]
    pub(crate) unsafe fn new() -> Self {
        Self(())
    }
}

impl Avx512 {
    /// Makes the value that proves these instructions.
    ///
    /// # Safety
    /// The CPU and the operating system offer AVX-512 F, BW, DQ, VL and VNNI.
    #[inline(always)]
    pub(crate) unsafe fn new() -> Self {
        Self(())
    }
}

impl<const NARROW: bool> Simd for Halves<NARROW> {
    type V = [__m256; 2];
    type Pairs = [__m256i; 2];
    type Integers = [__m256i; 2];

    const SUMS: usize = if NARROW { 8 } else { 4 };
    const CHAINS: usize = 1;
    const PIXELS: usize = 6;
    const PANELS: usize = 1;
    const INTEGER_TILE: [usize; 2] = [1, 6];

    #[inline(always)]
    fn splat(self, x: f32) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX2.
        [unsafe { _mm256_set1_ps(x) }; 2]
    }

    #[inline(always)]
    fn load(self, from: &Block) -> Self::V {
        let from = from.as_ptr();
        // SAFETY: the constructor of `self` guarantees AVX2; both halves lie inside the block.
        unsafe { [_mm256_loadu_ps(from), _mm256_loadu_ps(from.add(8))] }
    }

    #[inline(always)]
    fn store(self, [low, high]: Self::V, to: &mut Block) {
        let to = to.as_mut_ptr();
        // SAFETY: the constructor of `self` guarantees AVX2; both halves lie inside the block.
        unsafe {
            _mm256_storeu_ps(to, low);
            _mm256_storeu_ps(to.add(8), high);
        }
    }

    #[inline(always)]
    fn add(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX2.
        unsafe { [_mm256_add_ps(a[0], b[0]), _mm256_add_ps(a[1], b[1])] }
    }

    #[inline(always)]
    fn where_negative(self, [low, high]: Self::V, other: Self::V) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX2.
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
    fn at_most(self, x: Self::V, bound: Self::V) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX2. The second operand is taken where either is not a number.
        unsafe { [_mm256_min_ps(bound[0], x[0]), _mm256_min_ps(bound[1], x[1])] }
    }

    #[inline(always)]
    fn mul(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX2.
        unsafe { [_mm256_mul_ps(a[0], b[0]), _mm256_mul_ps(a[1], b[1])] }
    }

    #[inline(always)]
    fn add_product(self, sum: Self::V, a: Self::V, b: Self::V) -> Self::V {
        self.add(sum, self.mul(a, b))
    }

    #[inline(always)]
    fn load_f16(self, from: &[u16; LANES]) -> Self::V {
        let from = from.as_ptr();
        // SAFETY: the constructor of `self` guarantees AVX2 and F16C; both halves lie inside the block.
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
        // SAFETY: the constructor of `self` guarantees AVX2 and F16C; both halves lie inside the block.
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
        // SAFETY: the constructor of `self` guarantees AVX2; both halves lie inside the block.
        unsafe {
            [from, from.add(8)].map(|from| {
                let words = _mm256_cvtepu16_epi32(_mm_loadu_si128(from.cast()));
                _mm256_castsi256_ps(_mm256_slli_epi32::<16>(words))
            })
        }
    }

    #[inline(always)]
    fn load_bytes(self, from: &[i8; LANES]) -> Self::V {
        let from = from.as_ptr();
        // SAFETY: the constructor of `self` guarantees AVX2; both halves lie inside the block.
        unsafe {
            [from, from.add(8)]
                .map(|from| _mm256_cvtepi32_ps(_mm256_cvtepi8_epi32(_mm_loadl_epi64(from.cast()))))
        }
    }

    #[inline(always)]
    fn splat_pair(self, pair: &[i16; 2]) -> Self::Pairs {
        // SAFETY: the constructor of `self` guarantees AVX2.
        [unsafe { _mm256_set1_epi32(joined(*pair)) }; 2]
    }

    #[inline(always)]
    fn load_i16(self, from: &[i16; 2 * LANES]) -> Self::Pairs {
        let from = from.as_ptr();
        // SAFETY: the constructor of `self` guarantees AVX2; both halves, of sixteen integers each, lie inside the array.
        unsafe { [from, from.add(16)].map(|from| _mm256_loadu_si256(from.cast())) }
    }

    #[inline(always)]
    fn load_i8(self, from: &[i8; 2 * LANES]) -> Self::Pairs {
        let from = from.as_ptr();
        // SAFETY: the constructor of `self` guarantees AVX2; both halves, of sixteen bytes each, lie inside the array.
        unsafe {
            [from, from.add(16)].map(|from| _mm256_cvtepi8_epi16(_mm_loadu_si128(from.cast())))
        }
    }

    #[inline(always)]
    fn zeros(self) -> Self::Integers {
        // SAFETY: the constructor of `self` guarantees AVX2.
        [unsafe { _mm256_setzero_si256() }; 2]
    }

    #[inline(always)]
    fn add_products(self, sum: Self::Integers, a: Self::Pairs, b: Self::Pairs) -> Self::Integers {
        // SAFETY: the constructor of `self` guarantees AVX2.
        unsafe {
            [
                _mm256_add_epi32(sum[0], _mm256_madd_epi16(a[0], b[0])),
                _mm256_add_epi32(sum[1], _mm256_madd_epi16(a[1], b[1])),
            ]
        }
    }

    #[inline(always)]
    fn add_integers(self, a: Self::Integers, b: Self::Integers) -> Self::Integers {
        // SAFETY: the constructor of `self` guarantees AVX2.
        unsafe { [_mm256_add_epi32(a[0], b[0]), _mm256_add_epi32(a[1], b[1])] }
    }

    #[inline(always)]
    fn floats(self, integers: Self::Integers) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX2.
        integers.map(|integers| unsafe { _mm256_cvtepi32_ps(integers) })
    }

    #[inline(always)]
    fn whole(self, v: Self::V) -> [i16; LANES] {
        let mut to = [0; LANES];
        // SAFETY: the constructor of `self` guarantees AVX2; the array is sixteen numbers of sixteen bits.
        unsafe {
            let [low, high] = v.map(|v| {
                let bits = _mm256_castps_si256(_mm256_add_ps(v, _mm256_set1_ps(ROUND)));
                _mm256_srai_epi32::<16>(_mm256_slli_epi32::<16>(bits))
            });
            // Quarters 0 and 2 of either, then 1 and 3.
            let packed = _mm256_permute4x64_epi64::<0b11_01_10_00>(_mm256_packs_epi32(low, high));
            _mm256_storeu_si256(to.as_mut_ptr().cast(), packed);
        }
        to
    }

    #[inline(always)]
    fn larger(self, largest: Self::Integers, v: Self::V) -> Self::Integers {
        // SAFETY: the constructor of `self` guarantees AVX2.
        unsafe {
            let magnitude =
                |v| _mm256_and_si256(_mm256_castps_si256(v), _mm256_set1_epi32(MAGNITUDE));
            [
                _mm256_max_epi32(largest[0], magnitude(v[0])),
                _mm256_max_epi32(largest[1], magnitude(v[1])),
            ]
        }
    }

    #[inline(always)]
    fn largest(self, [low, high]: Self::Integers) -> u32 {
        // SAFETY: the constructor of `self` guarantees AVX2.
        unsafe {
            let eight = _mm256_max_epi32(low, high);
            let four = _mm_max_epi32(
                _mm256_castsi256_si128(eight),
                _mm256_extracti128_si256::<1>(eight),
            );
            let two = _mm_max_epi32(four, _mm_shuffle_epi32::<0b11_10_11_10>(four));
            let one = _mm_max_epi32(two, _mm_shuffle_epi32::<0b01_01_01_01>(two));
            _mm_cvtsi128_si32(one).cast_unsigned()
        }
    }
}

impl Simd for Avx512 {
    type V = __m512;
    type Pairs = __m512i;
    type Integers = __m512i;

    const SUMS: usize = 16;
    const CHAINS: usize = 2;
    const PIXELS: usize = 6;
    const PANELS: usize = 2;
    const INTEGER_TILE: [usize; 2] = [4, 6];

    #[inline(always)]
    fn splat(self, x: f32) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX-512.
        unsafe { _mm512_set1_ps(x) }
    }

    #[inline(always)]
    fn load(self, from: &Block) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX-512; a block is sixteen numbers.
        unsafe { _mm512_loadu_ps(from.as_ptr()) }
    }

    #[inline(always)]
    fn store(self, v: Self::V, to: &mut Block) {
        // SAFETY: the constructor of `self` guarantees AVX-512; a block is sixteen numbers.
        unsafe { _mm512_storeu_ps(to.as_mut_ptr(), v) }
    }

    #[inline(always)]
    fn add(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX-512.
        unsafe { _mm512_add_ps(a, b) }
    }

    #[inline(always)]
    fn where_negative(self, x: Self::V, other: Self::V) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX-512.
        unsafe {
            let negative = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(x, _mm512_setzero_ps());
            _mm512_mask_blend_ps(negative, x, other)
        }
    }

    #[inline(always)]
    fn at_most(self, x: Self::V, bound: Self::V) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX-512. The second operand is taken where either is not a number.
        unsafe { _mm512_min_ps(bound, x) }
    }

    #[inline(always)]
    fn mul(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX-512.
        unsafe { _mm512_mul_ps(a, b) }
    }

    #[inline(always)]
    fn add_product(self, sum: Self::V, a: Self::V, b: Self::V) -> Self::V {
        self.add(sum, self.mul(a, b))
    }

    #[inline(always)]
    fn load_f16(self, from: &[u16; LANES]) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX-512; a block is sixteen numbers.
        unsafe { _mm512_cvtph_ps(_mm256_loadu_si256(from.as_ptr().cast())) }
    }

    #[inline(always)]
    fn round_to_f16(self, v: Self::V) -> [u16; LANES] {
        let mut to = [0; LANES];
        // SAFETY: the constructor of `self` guarantees AVX-512; a block is sixteen numbers.
        unsafe {
            let halves = _mm512_cvtps_ph::<_MM_FROUND_TO_NEAREST_INT>(v);
            _mm256_storeu_si256(to.as_mut_ptr().cast(), halves);
        }
        to
    }

    #[inline(always)]
    fn load_bf16(self, from: &[u16; LANES]) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX-512; a block is sixteen numbers.
        unsafe {
            let words = _mm512_cvtepu16_epi32(_mm256_loadu_si256(from.as_ptr().cast()));
            _mm512_castsi512_ps(_mm512_slli_epi32::<16>(words))
        }
    }

    #[inline(always)]
    fn load_bytes(self, from: &[i8; LANES]) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX-512; a block is sixteen bytes.
        unsafe {
            let bytes = _mm_loadu_si128(from.as_ptr().cast());
            _mm512_cvtepi32_ps(_mm512_cvtepi8_epi32(bytes))
        }
    }

    #[inline(always)]
    fn splat_pair(self, pair: &[i16; 2]) -> Self::Pairs {
        // SAFETY: the constructor of `self` guarantees AVX-512.
        unsafe { _mm512_set1_epi32(joined(*pair)) }
    }

    #[inline(always)]
    fn load_i16(self, from: &[i16; 2 * LANES]) -> Self::Pairs {
        // SAFETY: the constructor of `self` guarantees AVX-512; the array is sixteen pairs.
        unsafe { _mm512_loadu_si512(from.as_ptr().cast()) }
    }

    #[inline(always)]
    fn load_i8(self, from: &[i8; 2 * LANES]) -> Self::Pairs {
        // SAFETY: the constructor of `self` guarantees AVX-512.
        unsafe { widened(from) }
    }

    #[inline(always)]
    fn zeros(self) -> Self::Integers {
        // SAFETY: the constructor of `self` guarantees AVX-512.
        unsafe { _mm512_setzero_si512() }
    }

    #[inline(always)]
    fn add_products(self, sum: Self::Integers, a: Self::Pairs, b: Self::Pairs) -> Self::Integers {
        // SAFETY: the constructor of `self` guarantees AVX-512.
        unsafe { _mm512_dpwssd_epi32(sum, a, b) }
    }

    #[inline(always)]
    fn add_integers(self, a: Self::Integers, b: Self::Integers) -> Self::Integers {
        // SAFETY: the constructor of `self` guarantees AVX-512.
        unsafe { _mm512_add_epi32(a, b) }
    }

    #[inline(always)]
    fn floats(self, integers: Self::Integers) -> Self::V {
        // SAFETY: the constructor of `self` guarantees AVX-512.
        unsafe { _mm512_cvtepi32_ps(integers) }
    }

    #[inline(always)]
    fn whole(self, v: Self::V) -> [i16; LANES] {
        let mut to = [0; LANES];
        // SAFETY: the constructor of `self` guarantees AVX-512; the array is sixteen numbers of sixteen bits.
        unsafe {
            let bits = _mm512_castps_si512(_mm512_add_ps(v, _mm512_set1_ps(ROUND)));
            _mm256_storeu_si256(to.as_mut_ptr().cast(), _mm512_cvtepi32_epi16(bits));
        }
        to
    }

    #[inline(always)]
    fn larger(self, largest: Self::Integers, v: Self::V) -> Self::Integers {
        // SAFETY: the constructor of `self` guarantees AVX-512.
        unsafe {
            let bits = _mm512_castps_si512(v);
            _mm512_max_epi32(
                largest,
                _mm512_and_si512(bits, _mm512_set1_epi32(MAGNITUDE)),
            )
        }
    }

    #[inline(always)]
    fn largest(self, integers: Self::Integers) -> u32 {
        // SAFETY: the constructor of `self` guarantees AVX-512.
        unsafe { _mm512_reduce_max_epi32(integers) }.cast_unsigned()
    }
}

/// Loads thirty-two bytes and widens them. By name, because compilers that know them to be bytes make
/// two instructions of a product and its sum.
///
/// # Safety
/// The CPU and the operating system offer AVX-512 F and BW.
#[target_feature(enable = "avx512f,avx512bw")]
#[inline]
unsafe fn widened(from: &[i8; 2 * LANES]) -> __m512i {
    let pairs: __m512i;
    // SAFETY: the caller promises the instruction; it reads thirty-two bytes, which the array has.
    unsafe {
        asm!(
            "vpmovsxbw {pairs}, ymmword ptr [{from}]",
            pairs = lateout(zmm_reg) pairs,
            from = in(reg) from.as_ptr(),
            options(pure, readonly, nostack, preserves_flags),
        );
    }
    pairs
}

/// Returns two 16-bit integers as the 32-bit integer of their bytes.
#[inline(always)]
fn joined([low, high]: [i16; 2]) -> i32 {
    i32::from(low.cast_unsigned()) | i32::from(high) << 16
}

/// Implements [`Simd::add_products`] for arrays with the x86-64 baseline, because compilers do not
/// find the instruction by themselves.
#[inline(always)]
pub(super) fn add_products(
    mut sum: [i32; LANES],
    a: [i16; 2 * LANES],
    b: [i16; 2 * LANES],
) -> [i32; LANES] {
    let (sums, _) = sum.as_chunks_mut::<4>();
    let ((a, _), (b, _)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
        let at = sum.as_mut_ptr().cast();
        // SAFETY: SSE2 is part of x86-64; each of the three is sixteen bytes.
        unsafe {
            let a = _mm_loadu_si128(a.as_ptr().cast());
            let b = _mm_loadu_si128(b.as_ptr().cast());
            let added = _mm_add_epi32(_mm_loadu_si128(at), _mm_madd_epi16(a, b));
            _mm_storeu_si128(at, added);
        }
    }
    sum
}
