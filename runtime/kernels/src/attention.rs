//! Causal multi-head attention over a key-value cache.
//!
//! Keys and values are read strictly in order, once for two queries and all heads, in the layout of
//! [`Cache`]: sixteen scores are sixteen lanes, and nothing is summed across lanes.
//! [`Append`](crate::Append) writes the rows of new tokens; [`Attention::run`] then reads them. For
//! one query and one head:
//!
//! ```text
//! s[r] = scale * (sum over d of q[d] * K[r][d])      r = 0..=own row
//! p[r] = exp(s[r] - max s) / sum over r of exp(s[r] - max s)
//! y    = sum over r of p[r] * V[r]
//! ```
//!
//! The scales of a cache of integers multiply the scores and the probabilities, sixteen rows at
//! once, so that the loops over the cache are those of floats.

use crate::cache::{Cache, Cached, keys_len};
use crate::dispatch::{Isa, Kernel};
use crate::lanes::{Block, LANES};
use crate::norm::exponentials;
use crate::simd::{Simd, prefetch_ahead};
use crate::stored::{F16, F32, Int8};

/// Number of queries that share one pass over the cache.
const TOGETHER: usize = 2;

/// Returns the number of elements of scratch that attention over a cache of `capacity` rows needs:
/// the scores of all heads for two queries.
pub const fn attention_scratch_len(queries: usize, heads: usize, capacity: usize) -> usize {
    let together = if queries < TOGETHER {
        queries
    } else {
        TOGETHER
    };
    keys_len(capacity, heads).saturating_mul(together)
}

/// Attention of a few queries to a cache that already holds the queries' own keys and values.
#[derive(Debug, Clone, Copy)]
pub struct Attention<'c> {
    /// Number of heads.
    pub heads: usize,
    /// Number of elements per head.
    pub head_dim: usize,
    /// Factor of the scores.
    pub scale: f32,
    /// Elements from one query to the next.
    pub q_stride: usize,
    /// Number of rows of the cache that the first query sees; each later query sees one more.
    pub visible: usize,
    /// Keys and values, rows of `heads * head_dim` elements.
    pub cache: Cache<'c>,
}

impl Attention<'_> {
    /// Computes `y`, `[queries, heads * head_dim]`. `scratch` is [`attention_scratch_len`] elements long.
    pub fn run(&self, isa: Isa, q: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        if self.heads * self.head_dim == 0 || self.q_stride == 0 {
            return;
        }
        match self.cache {
            Cache::F32 { keys, values } => {
                self.over::<F32>(isa, [keys, values], None, q, y, scratch);
            }
            Cache::F16 { keys, values } => {
                if cfg!(feature = "half-cache") {
                    self.over::<F16>(isa, [keys, values], None, q, y, scratch);
                }
            }
            Cache::Int8 { keys, values } => {
                if cfg!(feature = "integer-cache") {
                    let integers = [keys.integers, values.integers];
                    let scales = Some([keys.scales, values.scales]);
                    self.over::<Int8>(isa, integers, scales, q, y, scratch);
                }
            }
        }
    }

    /// Runs attention over a cache whose format is known at compile time.
    fn over<C: Cached>(
        &self,
        isa: Isa,
        [keys, values]: [&[C::Bits]; 2],
        scales: Option<[&[f32]; 2]>,
        q: &[f32],
        y: &mut [f32],
        scratch: &mut [f32],
    ) {
        let width = self.heads * self.head_dim;
        let mut qs = q.chunks(self.q_stride.max(1));
        let mut visible = self.visible;
        for y in y.chunks_mut((TOGETHER * width).max(1)) {
            let queries = y.len().checked_div(width).unwrap_or(0);
            let q = [qs.next(), qs.next()].map(|q| q.and_then(|q| q.get(..width)).unwrap_or(&[]));
            // A slice that is too short.
            let Some((y0, y1)) = y.split_at_mut_checked(width) else {
                return;
            };
            if q.iter().take(queries).any(|q| q.is_empty()) {
                return;
            }
            // The rows that the last query sees. An earlier query gives those that it does not see weight zero.
            let rows = visible + queries - 1;
            // Keys are read in whole blocks, so the last one may bring keys beyond `rows`, such as an earlier episode's. `Probabilities`
            // replaces their scores, whatever they are, before anything reads them; values beyond `rows` are not read.
            let blocks = rows.div_ceil(LANES);
            let (p, _) = scratch.as_chunks_mut::<LANES>();
            let Some(p) = p.get_mut(..queries * self.heads * blocks) else {
                return;
            };
            isa.run(Scores::<C> {
                op: self,
                keys,
                q,
                queries,
                blocks,
                p,
            });
            self.weights(isa, scales, visible, blocks, p);
            let sums = Sums::<C> {
                op: self,
                values: values.get(..rows * width).unwrap_or(&[]),
                visible,
                p: p.as_flattened(),
                len: blocks * LANES,
                queries,
                y: [y0, y1],
            };
            if self.head_dim.is_multiple_of(LANES) {
                isa.run(sums);
            } else {
                sums.one_by_one();
            }
            visible += queries;
        }
    }
}

impl Attention<'_> {
    /// Makes scores into the weights of the values. Out of line, so that caches of all formats share
    /// one compiled body.
    #[inline(never)]
    fn weights(
        &self,
        isa: Isa,
        scales: Option<[&[f32]; 2]>,
        visible: usize,
        blocks: usize,
        p: &mut [Block],
    ) {
        let heads = self.heads;
        let [of_keys, of_values] = scales.unwrap_or_default();
        isa.run(Scaled {
            heads,
            scales: of_keys,
            blocks,
            p,
        });
        isa.run(Probabilities {
            heads,
            visible,
            blocks,
            p,
        });
        isa.run(Scaled {
            heads,
            scales: of_values,
            blocks,
            p,
        });
    }
}

/// Computes the scores `p[query][head][row] = scale * dot(q, K[row])`.
struct Scores<'a, C: Cached> {
    op: &'a Attention<'a>,
    keys: &'a [C::Bits],
    q: [&'a [f32]; TOGETHER],
    queries: usize,
    blocks: usize,
    p: &'a mut [Block],
}

impl<C: Cached> Kernel for Scores<'_, C> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let [q, _] = self.q;
        if self.queries == TOGETHER {
            let q = self.q;
            self.score(simd, q);
        } else {
            self.score(simd, [q]);
        }
    }
}

impl<C: Cached> Scores<'_, C> {
    #[inline(always)]
    fn score<S: Simd, const R: usize>(self, simd: S, q: [&[f32]; R]) {
        let (heads, head_dim) = (self.op.heads, self.op.head_dim);
        let scale = simd.splat(self.op.scale);
        let (lines, _) = self.keys.as_chunks::<LANES>();
        for (b, block) in lines
            .chunks_exact((heads * head_dim).max(1))
            .take(self.blocks)
            .enumerate()
        {
            for (head, lines) in block.chunks_exact(head_dim.max(1)).enumerate() {
                let first = head * head_dim;
                let q = q.map(|q| q.get(first..first + head_dim).unwrap_or(&[]));
                let sums = dots::<C, S, R>(simd, q, lines);
                for (r, sum) in sums.into_iter().enumerate() {
                    if let Some(p) = self.p.get_mut((r * heads + head) * self.blocks + b) {
                        simd.store(simd.mul(sum, scale), p);
                    }
                }
            }
        }
    }
}

/// Computes the softmax of the scores of every query and head over the rows that the query sees;
/// zero for the others.
struct Probabilities<'a> {
    heads: usize,
    visible: usize,
    blocks: usize,
    p: &'a mut [Block],
}

impl Kernel for Probabilities<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        for (i, p) in self.p.chunks_exact_mut(self.blocks.max(1)).enumerate() {
            let seen = self.visible + i / self.heads.max(1);
            let p = p.as_flattened_mut();
            for p in p.get_mut(seen..).unwrap_or(&mut []) {
                *p = f32::NEG_INFINITY;
            }
            let scale = 1.0 / exponentials(p);
            for p in p {
                *p *= scale;
            }
        }
    }
}

/// Multiplies scores or probabilities by the scales of the rows that they are of, if there are any; what
/// lies beyond the visible rows becomes anything, and is not read.
struct Scaled<'a> {
    heads: usize,
    /// Scales, `[heads][capacity / 16][16]`.
    scales: &'a [f32],
    blocks: usize,
    p: &'a mut [Block],
}

impl Kernel for Scaled<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let (scales, _) = self.scales.as_chunks::<LANES>();
        let of_head = scales.len().checked_div(self.heads).unwrap_or(0).max(1);
        let of_all = scales.chunks_exact(of_head).cycle();
        for (p, scales) in self.p.chunks_exact_mut(self.blocks.max(1)).zip(of_all) {
            for (p, scales) in p.iter_mut().zip(scales) {
                simd.store(simd.mul(simd.load(p), simd.load(scales)), p);
            }
        }
    }
}

/// Computes the weighted sums `y = sum over rows of p[row] * V[row]`, in the order of the rows; `p`
/// is `[query][head][len]`.
struct Sums<'a, C: Cached> {
    op: &'a Attention<'a>,
    values: &'a [C::Bits],
    visible: usize,
    p: &'a [f32],
    len: usize,
    queries: usize,
    y: [&'a mut [f32]; TOGETHER],
}

impl<C: Cached> Kernel for Sums<'_, C> {
    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        let y = core::mem::take(&mut self.y);
        if self.queries == TOGETHER {
            self.weigh_all(simd, y);
        } else {
            let [y, _] = y;
            self.weigh_all(simd, [y]);
        }
    }
}

impl<C: Cached> Sums<'_, C> {
    /// Returns the probabilities of a query's head.
    #[inline(always)]
    fn of(&self, query: usize, head: usize) -> &[f32] {
        let start = (query * self.op.heads + head) * self.len;
        self.p.get(start..start + self.len).unwrap_or(&[])
    }

    /// Computes heads that are not a whole number of blocks: element by element, each sum in the
    /// same order.
    fn one_by_one(mut self) {
        let width = self.op.heads * self.op.head_dim;
        let y = core::mem::take(&mut self.y);
        for (r, y) in y.into_iter().enumerate() {
            for (i, y) in y.iter_mut().enumerate() {
                let column = self.values.iter().skip(i).step_by(width.max(1));
                let p = self.of(r, i / self.op.head_dim.max(1));
                let seen = column.take(self.visible + r).zip(p);
                *y = seen.fold(0.0, |sum, (&v, &p)| sum + p * C::number(v));
            }
        }
    }

    #[inline(always)]
    fn weigh_all<S: Simd, const R: usize>(&self, simd: S, mut y: [&mut [f32]; R]) {
        let (heads, head_dim) = (self.op.heads, self.op.head_dim.max(1));
        let blocks = heads * head_dim / LANES;
        let (values, _) = self.values.as_chunks::<LANES>();
        let of_block = |r: usize, block: usize| self.of(r, block * LANES / head_dim);
        let mut block = 0;
        while block < blocks {
            let left = blocks - block;
            let place = [blocks, block];
            let y = y.each_mut().map(|y| &mut **y);
            block += if S::SUMS >= 8 * R && left >= 8 {
                weigh::<C, S, 8, R>(simd, of_block, values, place, self.visible, y)
            } else if S::SUMS >= 2 * R && left >= 2 {
                weigh::<C, S, 2, R>(simd, of_block, values, place, self.visible, y)
            } else {
                weigh::<C, S, 1, R>(simd, of_block, values, place, self.visible, y)
            };
        }
    }
}

/// Computes the products of `R` queries with sixteen keys, each summed in order.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "arrays whose length is a constant, as is every index"
)]
#[expect(
    unsafe_code,
    reason = "the sums stay in registers only without a branch in the loop, and compilers keep some of the bounds checks"
)]
fn dots<C: Cached, S: Simd, const R: usize>(
    simd: S,
    q: [&[f32]; R],
    keys: &[[C::Bits; LANES]],
) -> [S::V; R] {
    let mut sums = [simd.splat(0.0); R];
    if q.iter().any(|q| q.len() != keys.len()) {
        return sums;
    }
    for (d, key) in keys.iter().enumerate() {
        prefetch_ahead(d, key);
        let key = C::load(simd, key);
        for r in 0..R {
            // SAFETY: `q[r]` is as long as `keys`, as compared above, and `d` is an index of `keys`.
            let q = unsafe { *q[r].get_unchecked(d) };
            sums[r] = simd.add_product(sums[r], simd.splat(q), key);
        }
    }
    sums
}

/// Computes `P` blocks of `y`, starting at block `first` of `blocks`, and returns `P`.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "arrays whose length is a constant, as is every index"
)]
#[expect(
    unsafe_code,
    reason = "the sums stay in registers only without a branch in the loop, and compilers keep some of the bounds checks"
)]
fn weigh<'p, C: Cached, S: Simd, const P: usize, const R: usize>(
    simd: S,
    p: impl Fn(usize, usize) -> &'p [f32],
    values: &[[C::Bits; LANES]],
    [blocks, first]: [usize; 2],
    visible: usize,
    y: [&mut [f32]; R],
) -> usize {
    let mut sums = [[simd.splat(0.0); P]; R];
    let rows = visible + R - 1;
    let p: [[&[f32]; P]; R] = core::array::from_fn(|r| core::array::from_fn(|b| p(r, first + b)));
    if p.iter().flatten().any(|p| p.len() < rows) {
        return P;
    }
    for (row, v) in values.chunks_exact(blocks.max(1)).take(rows).enumerate() {
        let v: &[[C::Bits; LANES]; P] = match v.get(first..).and_then(<[_]>::first_chunk) {
            Some(v) => v,
            None => return P,
        };
        for b in 0..P {
            prefetch_ahead(b, &v[b]);
            let v = C::load(simd, &v[b]);
            for r in 0..R {
                // SAFETY: each `p[r][b]` has at least `rows` elements, as compared above, and `row < rows`.
                let p = unsafe { *p[r][b].get_unchecked(row) };
                sums[r][b] = simd.add_product(sums[r][b], simd.splat(p), v);
            }
        }
    }
    for (sums, y) in sums.into_iter().zip(y) {
        let (y, _) = y.as_chunks_mut::<LANES>();
        for (sum, y) in sums.into_iter().zip(y.get_mut(first..).unwrap_or(&mut [])) {
            simd.store(sum, y);
        }
    }
    P
}
