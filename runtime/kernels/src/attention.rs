//! Causal multi-head attention over a key-value cache.
//!
//! Both halves of the cache are read strictly in order, once for two queries and all heads. Keys lie in blocks of sixteen tokens,
//! each block transposed, `[capacity / 16][heads * head_dim][16]`, so that sixteen scores are sixteen lanes and nothing is summed
//! across lanes; values lie one contiguous row per token, `[capacity][heads * head_dim]`. [`append_keys`] and [`append_values`]
//! write the rows of new tokens; [`Attention::run`] then reads them. For one query and one head:
//!
//! ```text
//! s[r] = scale * (sum over d of q[d] * K[r][d])      r = 0..=own row
//! p[r] = exp(s[r] - max s) / sum over r of exp(s[r] - max s)
//! y    = sum over r of p[r] * V[r]
//! ```

use crate::dispatch::{Isa, Kernel};
use crate::elementwise::assign;
use crate::lanes::{Block, LANES};
use crate::norm::exponentials;
use crate::simd::Simd;

/// Queries that go through the cache together.
const TOGETHER: usize = 2;

/// Elements of a half of a cache of `capacity` rows: the keys' last block is a whole one.
pub const fn keys_len(capacity: usize, width: usize) -> usize {
    capacity.next_multiple_of(LANES).saturating_mul(width)
}

/// Elements of scratch that attention over a cache of `capacity` rows needs: the scores of all heads for two queries.
pub const fn attention_scratch_len(queries: usize, heads: usize, capacity: usize) -> usize {
    let together = if queries < TOGETHER {
        queries
    } else {
        TOGETHER
    };
    keys_len(capacity, heads).saturating_mul(together)
}

/// Writes rows of `width` elements, `stride` elements apart in `x`, to the rows of the values from `first` on.
pub fn append_values(x: &[f32], stride: usize, width: usize, cache: &mut [f32], first: usize) {
    let rows = cache.get_mut(first * width..).unwrap_or(&mut []);
    for (row, x) in rows
        .chunks_exact_mut(width.max(1))
        .zip(x.chunks(stride.max(1)))
    {
        if let Some(x) = x.get(..width) {
            assign(row, x);
        }
    }
}

/// The same for the keys.
pub fn append_keys(x: &[f32], stride: usize, width: usize, cache: &mut [f32], first: usize) {
    for (i, x) in x.chunks(stride.max(1)).enumerate() {
        let (block, lane) = ((first + i) / LANES, (first + i) % LANES);
        let block = cache
            .chunks_exact_mut(width.saturating_mul(LANES).max(1))
            .nth(block);
        let (lines, _) = block.unwrap_or(&mut []).as_chunks_mut::<LANES>();
        for (line, &x) in lines.iter_mut().zip(x) {
            if let Some(to) = line.get_mut(lane) {
                *to = x;
            }
        }
    }
}

/// Attention of a few queries to a cache that already holds their own keys and values.
#[derive(Debug, Clone, Copy)]
pub struct Attention<'c> {
    /// Heads.
    pub heads: usize,
    /// Elements per head.
    pub head_dim: usize,
    /// Multiplies the scores.
    pub scale: f32,
    /// Elements from one query to the next.
    pub q_stride: usize,
    /// How many rows of the cache the first query sees; each later query sees one more.
    pub visible: usize,
    /// Keys, [`keys_len`] elements.
    pub cache_k: &'c [f32],
    /// Values, `[capacity, heads * head_dim]`.
    pub cache_v: &'c [f32],
}

impl Attention<'_> {
    /// Computes `y`, `[queries, heads * head_dim]`. `scratch` is [`attention_scratch_len`] elements long.
    pub fn run(&self, isa: Isa, q: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        if self.heads * self.head_dim > 0 && self.q_stride > 0 {
            isa.run(Queries {
                attention: self,
                q,
                y,
                scratch,
            });
        }
    }
}

/// Attention at work.
struct Queries<'a> {
    attention: &'a Attention<'a>,
    q: &'a [f32],
    y: &'a mut [f32],
    scratch: &'a mut [f32],
}

impl Kernel for Queries<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let width = self.attention.heads * self.attention.head_dim;
        let mut qs = self.q.chunks(self.attention.q_stride.max(1));
        let mut pairs = self.y.chunks_exact_mut((TOGETHER * width).max(1));
        let mut visible = self.attention.visible;
        for y in pairs.by_ref() {
            let (Some(q0), Some(q1)) = (qs.next(), qs.next()) else {
                return;
            };
            let Some((y0, y1)) = y.split_at_mut_checked(width) else {
                return;
            };
            together::<S, 2>(
                simd,
                self.attention,
                visible,
                [q0, q1],
                [y0, y1],
                self.scratch,
            );
            visible += TOGETHER;
        }
        let y = pairs.into_remainder();
        if let Some(q) = qs.next()
            && y.len() == width
        {
            together::<S, 1>(simd, self.attention, visible, [q], [y], self.scratch);
        }
    }
}

/// `R` queries, the first of which sees `visible` rows.
#[inline(always)]
fn together<S: Simd, const R: usize>(
    simd: S,
    op: &Attention,
    visible: usize,
    q: [&[f32]; R],
    y: [&mut [f32]; R],
    scratch: &mut [f32],
) {
    // Scores of a query and head take whole blocks, of which the last may reach beyond the visible rows.
    let blocks = (visible + R - 1).div_ceil(LANES);
    let (p, _) = scratch.as_chunks_mut::<LANES>();
    let Some(p) = p.get_mut(..R * op.heads * blocks) else {
        return;
    };
    let width = op.heads * op.head_dim;
    let q = q.map(|q| q.get(..width).unwrap_or(&[]));
    score(simd, op, q, blocks, p);
    for (i, p) in p.chunks_exact_mut(blocks.max(1)).enumerate() {
        let seen = visible + i / op.heads.max(1);
        let p = p.as_flattened_mut();
        for p in p.get_mut(seen..).unwrap_or(&mut []) {
            *p = f32::NEG_INFINITY;
        }
        let scale = 1.0 / exponentials(p);
        for p in p {
            *p *= scale;
        }
    }
    // The rows that the last query sees; earlier ones have weight zero there, and cache rows beyond are never read.
    let rows = visible + R - 1;
    let values = op.cache_v.get(..rows * width).unwrap_or(&[]);
    weigh_all(
        simd,
        op,
        p.as_flattened(),
        blocks * LANES,
        values,
        visible,
        y,
    );
}

/// `p[query][head][row] = scale * dot(q, K[row])`
#[inline(always)]
fn score<S: Simd, const R: usize>(
    simd: S,
    op: &Attention,
    q: [&[f32]; R],
    blocks: usize,
    p: &mut [Block],
) {
    let (heads, head_dim) = (op.heads, op.head_dim);
    let scale = simd.splat(op.scale);
    let (lines, _) = op.cache_k.as_chunks::<LANES>();
    for (b, block) in lines
        .chunks_exact((heads * head_dim).max(1))
        .take(blocks)
        .enumerate()
    {
        for (head, lines) in block.chunks_exact(head_dim.max(1)).enumerate() {
            let first = head * head_dim;
            let q = q.map(|q| q.get(first..first + head_dim).unwrap_or(&[]));
            let sums = dots(simd, q, lines);
            for (r, sum) in sums.into_iter().enumerate() {
                if let Some(p) = p.get_mut((r * heads + head) * blocks + b) {
                    simd.store(simd.mul(sum, scale), p);
                }
            }
        }
    }
}

/// The products of `R` queries with sixteen keys, each summed in order.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "arrays whose length is a constant, as is every index"
)]
#[expect(
    unsafe_code,
    reason = "the sums stay in registers only without a branch in the loop, and compilers keep some of the bounds checks"
)]
fn dots<S: Simd, const R: usize>(simd: S, q: [&[f32]; R], keys: &[Block]) -> [S::V; R] {
    let mut sums = [simd.splat(0.0); R];
    if q.iter().any(|q| q.len() != keys.len()) {
        return sums;
    }
    for (d, key) in keys.iter().enumerate() {
        let key = simd.load(key);
        for r in 0..R {
            // SAFETY: `q[r]` is as long as `keys`, as compared above, and `d` is an index of `keys`.
            let q = unsafe { *q[r].get_unchecked(d) };
            sums[r] = simd.add_product(sums[r], simd.splat(q), key);
        }
    }
    sums
}

/// `y = sum over rows of p[row] * V[row]`, in the order of the rows; `p` is `[query][head][len]`.
#[inline(always)]
fn weigh_all<S: Simd, const R: usize>(
    simd: S,
    op: &Attention,
    p: &[f32],
    len: usize,
    values: &[f32],
    visible: usize,
    y: [&mut [f32]; R],
) {
    let (heads, head_dim) = (op.heads, op.head_dim.max(1));
    let width = (heads * head_dim).max(1);
    let of = |r: usize, head: usize| {
        let start = (r * heads + head) * len;
        p.get(start..start + len).unwrap_or(&[])
    };
    if !head_dim.is_multiple_of(LANES) {
        // Heads that are no whole number of blocks: element by element, each sum in the same order.
        for (r, y) in y.into_iter().enumerate() {
            for (i, y) in y.iter_mut().enumerate() {
                let column = values.iter().skip(i).step_by(width).take(visible + r);
                let p = of(r, i / head_dim);
                *y = column.zip(p).fold(0.0, |sum, (&v, &p)| sum + p * v);
            }
        }
        return;
    }
    let blocks = width / LANES;
    let (values, _) = values.as_chunks::<LANES>();
    let of_block = |r: usize, block: usize| of(r, block * LANES / head_dim);
    let mut y = y;
    let mut block = 0;
    while block < blocks {
        let left = blocks - block;
        let y = y.each_mut().map(|y| &mut **y);
        if S::SUMS >= 8 * R && left >= 8 {
            weigh::<S, 8, R>(simd, of_block, values, [blocks, block], visible, y);
            block += 8;
        } else if S::SUMS >= 4 * R && left >= 4 {
            weigh::<S, 4, R>(simd, of_block, values, [blocks, block], visible, y);
            block += 4;
        } else if S::SUMS >= 2 * R && left >= 2 {
            weigh::<S, 2, R>(simd, of_block, values, [blocks, block], visible, y);
            block += 2;
        } else {
            weigh::<S, 1, R>(simd, of_block, values, [blocks, block], visible, y);
            block += 1;
        }
    }
}

/// `P` blocks of `y`, from block `first` of `blocks` on.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "arrays whose length is a constant, as is every index"
)]
#[expect(
    unsafe_code,
    reason = "the sums stay in registers only without a branch in the loop, and compilers keep some of the bounds checks"
)]
fn weigh<'p, S: Simd, const P: usize, const R: usize>(
    simd: S,
    p: impl Fn(usize, usize) -> &'p [f32],
    values: &[Block],
    [blocks, first]: [usize; 2],
    visible: usize,
    y: [&mut [f32]; R],
) {
    let mut sums = [[simd.splat(0.0); P]; R];
    let rows = visible + R - 1;
    let p: [[&[f32]; P]; R] = core::array::from_fn(|r| core::array::from_fn(|b| p(r, first + b)));
    if p.iter().flatten().any(|p| p.len() < rows) {
        return;
    }
    for (row, v) in values.chunks_exact(blocks.max(1)).take(rows).enumerate() {
        let v: &[Block; P] = match v.get(first..).and_then(<[_]>::first_chunk) {
            Some(v) => v,
            None => return,
        };
        for b in 0..P {
            let v = simd.load(&v[b]);
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
}
