//! Causal multi-head attention over a key-value cache.
//!
//! The cache is two matrices `[capacity, heads * head_dim]`, one contiguous row per token with all heads side by side.
//! [`append`] writes the rows of new tokens; [`Attention::run`] then reads it. For one query and one head:
//!
//! ```text
//! s[r] = scale * dot(q, K[r])           r = 0..=own row
//! p[r] = exp(s[r] - max s)
//! y    = (sum over r of p[r] * V[r]) / sum p
//! ```
//!
//! Departures for speed: the dot product runs in sixteen lanes, the weighted sum keeps sixteen elements of `y` in registers and
//! runs over all rows for each such block, and the division by the sum comes last.

use crate::lanes::{LANES, add_products, add_scaled, tree};
use crate::norm::exponentials;

/// Elements of scratch that attention over a cache of `capacity` rows needs: the scores of one query and one head.
pub const fn attention_scratch_len(queries: usize, capacity: usize) -> usize {
    if queries == 0 { 0 } else { capacity }
}

/// Writes rows of `width` elements, `stride` elements apart in `x`, to the rows of `cache` from `first` on.
pub fn append(x: &[f32], stride: usize, width: usize, cache: &mut [f32], first: usize) {
    let rows = cache.get_mut(first * width..).unwrap_or(&mut []);
    for (row, x) in rows
        .chunks_exact_mut(width.max(1))
        .zip(x.chunks(stride.max(1)))
    {
        if let Some(x) = x.get(..width) {
            row.copy_from_slice(x);
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
    /// Keys, `[capacity, heads * head_dim]`.
    pub cache_k: &'c [f32],
    /// Values, `[capacity, heads * head_dim]`.
    pub cache_v: &'c [f32],
}

impl Attention<'_> {
    /// Computes `y`, `[queries, heads * head_dim]`. `scratch` is [`attention_scratch_len`] elements long.
    pub fn run(&self, q: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let width = self.heads * self.head_dim;
        if width == 0 || self.q_stride == 0 {
            return;
        }
        let queries = q.chunks(self.q_stride).zip(y.chunks_exact_mut(width));
        for (i, (q, y)) in queries.enumerate() {
            let Some(p) = scratch.get_mut(..self.visible + i) else {
                return;
            };
            let heads = q
                .chunks_exact(self.head_dim)
                .zip(y.chunks_exact_mut(self.head_dim));
            for (head, (q, y)) in heads.enumerate() {
                let first = head * self.head_dim;
                score(q, self.cache_k, [width, first], self.scale, p);
                let scale = 1.0 / exponentials(p);
                if self.head_dim.is_multiple_of(LANES) {
                    weigh(p, self.cache_v, [width, first], scale, y);
                } else {
                    weigh_uneven(p, self.cache_v, [width, first], scale, y);
                }
            }
        }
    }
}

/// `p[r] = scale * dot(q, K[r])`, where row `r` of the head starts at `r * width + first`.
#[inline(never)]
fn score(q: &[f32], keys: &[f32], [width, first]: [usize; 2], scale: f32, p: &mut [f32]) {
    for (p, k) in p.iter_mut().zip(keys.chunks_exact(width)) {
        *p = dot(q, k.get(first..first + q.len()).unwrap_or(&[])) * scale;
    }
}

/// `y = scale * (sum over r of p[r] * V[r])` in the order of the rows; whole blocks of lanes.
#[inline(never)]
fn weigh(p: &[f32], values: &[f32], [width, first]: [usize; 2], scale: f32, y: &mut [f32]) {
    let (blocks, _) = values.as_chunks::<LANES>();
    let (ys, _) = y.as_chunks_mut::<LANES>();
    for (i, y) in ys.iter_mut().enumerate() {
        let mut sum = [0.0; LANES];
        for (&p, row) in p.iter().zip(blocks.chunks_exact(width / LANES)) {
            if let Some(v) = row.get(first / LANES + i) {
                add_scaled(&mut sum, p, v);
            }
        }
        for (y, sum) in y.iter_mut().zip(sum) {
            *y = sum * scale;
        }
    }
}

/// The same for heads that are no whole number of blocks: element by element, each sum in the same order.
fn weigh_uneven(p: &[f32], values: &[f32], [width, first]: [usize; 2], scale: f32, y: &mut [f32]) {
    for (i, y) in y.iter_mut().enumerate() {
        let column = values.iter().skip(first + i).step_by(width);
        *y = column.zip(p).fold(0.0, |sum, (&v, &p)| sum + p * v) * scale;
    }
}

/// The dot product in lanes.
#[inline(always)]
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let (a_blocks, a_tail) = a.as_chunks::<LANES>();
    let (b_blocks, b_tail) = b.as_chunks::<LANES>();
    let mut acc = [0.0; LANES];
    for (a, b) in a_blocks.iter().zip(b_blocks) {
        add_products(&mut acc, a, b);
    }
    for ((acc, &a), &b) in acc.iter_mut().zip(a_tail).zip(b_tail) {
        *acc += a * b;
    }
    tree(&acc)
}
