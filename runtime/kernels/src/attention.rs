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
//! Departures for speed: the dot product runs in sixteen lanes, the weighted sum keeps thirty-two elements of `y` in registers
//! and runs over all rows for each such pair of blocks, and the division by the sum comes last.

use crate::dispatch::{Isa, Kernel};
use crate::elementwise::assign;
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
            assign(row, x);
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

    /// One query and one head, whose elements start at `first` in a row of the cache; `p` has an element for each visible row.
    #[inline(always)]
    fn head(&self, q: &[f32], first: usize, p: &mut [f32], y: &mut [f32]) {
        let at = [self.heads * self.head_dim, first];
        score(q, self.cache_k, at, self.scale, p);
        let scale = 1.0 / exponentials(p);
        if self.head_dim.is_multiple_of(LANES) {
            let (pairs, rest) = y.as_chunks_mut::<{ 2 * LANES }>();
            for (i, y) in pairs.iter_mut().enumerate() {
                let at = [at[0], first + i * 2 * LANES];
                weigh::<2>(p, self.cache_v, at, scale, y);
            }
            if !rest.is_empty() {
                let at = [at[0], first + pairs.len() * 2 * LANES];
                weigh::<1>(p, self.cache_v, at, scale, rest);
            }
        } else {
            weigh_uneven(p, self.cache_v, at, scale, y);
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
    fn run<const WIDE: usize>(self) {
        let Attention {
            heads, head_dim, ..
        } = *self.attention;
        let queries = self.q.chunks(self.attention.q_stride.max(1));
        let ys = self.y.chunks_exact_mut((heads * head_dim).max(1));
        for (i, (q, y)) in queries.zip(ys).enumerate() {
            let Some(p) = self.scratch.get_mut(..self.attention.visible + i) else {
                return;
            };
            let dim = head_dim.max(1);
            let parts = q.chunks_exact(dim).zip(y.chunks_exact_mut(dim));
            for (head, (q, y)) in parts.enumerate() {
                self.attention.head(q, head * head_dim, p, y);
            }
        }
    }
}

/// `p[r] = scale * dot(q, K[r])`, where row `r` of the head starts at `r * width + first`.
#[inline(always)]
fn score(q: &[f32], keys: &[f32], [width, first]: [usize; 2], scale: f32, p: &mut [f32]) {
    for (p, k) in p.iter_mut().zip(keys.chunks_exact(width.max(1))) {
        *p = dot(q, k.get(first..first + q.len()).unwrap_or(&[])) * scale;
    }
}

/// `y = scale * (sum over r of p[r] * V[r])` in the order of the rows, for `B` blocks of `y` from `first` on.
#[inline(always)]
fn weigh<const B: usize>(
    p: &[f32],
    values: &[f32],
    [width, first]: [usize; 2],
    scale: f32,
    y: &mut [f32],
) {
    let mut sums = [[0.0; LANES]; B];
    let (blocks, _) = values.as_chunks::<LANES>();
    for (&p, row) in p.iter().zip(blocks.chunks_exact((width / LANES).max(1))) {
        let row = row.get(first / LANES..).and_then(|row| row.first_chunk());
        let row: &[_; B] = row.unwrap_or(&[[0.0; LANES]; B]);
        for (sum, v) in sums.iter_mut().zip(row) {
            add_scaled(sum, p, v);
        }
    }
    for (y, sum) in y.iter_mut().zip(sums.as_flattened()) {
        *y = sum * scale;
    }
}

/// The same for heads that are no whole number of blocks: element by element, each sum in the same order.
#[inline(always)]
fn weigh_uneven(p: &[f32], values: &[f32], [width, first]: [usize; 2], scale: f32, y: &mut [f32]) {
    for (i, y) in y.iter_mut().enumerate() {
        let column = values.iter().skip(first + i).step_by(width.max(1));
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
