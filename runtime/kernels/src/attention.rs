//! Causal multi-head attention over a key-value cache.
//!
//! The cache is two matrices `[capacity, heads * head_dim]`, one contiguous row per token with all heads side by side.
//! [`append`] writes the rows of new tokens; [`Attention::run`] then reads it. Pseudocode for one query and one head:
//!
//! ```text
//! s[r] = scale * dot(q, K[r])           r = 0..=own row
//! p[r] = exp(s[r] - max s)
//! y    = (sum over r of p[r] * V[r]) / sum p
//! ```
//!
//! Departures for speed: two queries share each sweep over the cache (the two tokens of a control step), and the division by
//! the sum comes last.

use core::array;

use crate::lanes::{Block, LANES, add_products, add_scaled, tree};
use crate::norm::exponentials;

/// Elements of scratch that attention over a cache of `capacity` rows needs: one row of scores for each of two queries.
pub const fn attention_scratch_len(queries: usize, capacity: usize) -> usize {
    (if queries < 2 { queries } else { 2 }) * capacity
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
        let mut qs = q.chunks(self.q_stride);
        let mut visible = self.visible;
        for y in y.chunks_mut(2 * width) {
            let q0 = qs.next().unwrap_or(&[]);
            if y.len() > width {
                let q1 = qs.next().unwrap_or(&[]);
                self.group([q0, q1], visible, y, scratch);
            } else {
                self.group([q0], visible, y, scratch);
            }
            visible += 2;
        }
    }

    /// Consecutive queries that share the sweeps; query `i` sees `visible + i` rows. `y` is `[Q, heads * head_dim]`.
    fn group<const Q: usize>(
        &self,
        qs: [&[f32]; Q],
        visible: usize,
        y: &mut [f32],
        scratch: &mut [f32],
    ) {
        let mut rows = scratch.chunks_exact_mut(visible + Q - 1);
        let mut scores: [&mut [f32]; Q] = array::from_fn(|i| {
            let row = rows.next().unwrap_or(&mut []);
            row.get_mut(..visible + i).unwrap_or(&mut [])
        });
        let mut ys = y.chunks_exact_mut(self.heads * self.head_dim);
        let mut ys: [&mut [f32]; Q] = array::from_fn(|_| ys.next().unwrap_or(&mut []));
        for head in 0..self.heads {
            let part = head * self.head_dim..(head + 1) * self.head_dim;
            self.score(
                head,
                qs.map(|q| q.get(part.clone()).unwrap_or(&[])),
                &mut scores,
            );
            let scales = scores.each_mut().map(|row| 1.0 / exponentials(row));
            let ys = ys
                .each_mut()
                .map(|y| y.get_mut(part.clone()).unwrap_or(&mut []));
            self.weigh(head, scores.each_ref().map(|row| &**row), scales, ys);
        }
    }

    /// `scores[i][r] = scale * dot(q[i], K[r])`, as many rows as each query sees.
    #[inline(always)]
    fn score<const Q: usize>(&self, head: usize, q: [&[f32]; Q], scores: &mut [&mut [f32]; Q]) {
        let first = head * self.head_dim;
        let mut scores = scores.each_mut().map(|row| row.iter_mut());
        for k in self.cache_k.chunks_exact(self.heads * self.head_dim) {
            let k = k.get(first..first + self.head_dim).unwrap_or(&[]);
            let mut seen = false;
            for (q, scores) in q.iter().zip(&mut scores) {
                if let Some(score) = scores.next() {
                    *score = dot(q, k) * self.scale;
                    seen = true;
                }
            }
            if !seen {
                return;
            }
        }
    }

    /// `y[i] = scale[i] * (sum over r of p[i][r] * V[r])`, in the order of the rows.
    #[inline(always)]
    fn weigh<const Q: usize>(
        &self,
        head: usize,
        p: [&[f32]; Q],
        scale: [f32; Q],
        ys: [&mut [f32]; Q],
    ) {
        let width = self.heads * self.head_dim;
        let (blocks, _) = self.cache_v.as_chunks::<LANES>();
        if !self.head_dim.is_multiple_of(LANES) {
            return self.weigh_uneven(head, p, scale, ys);
        }
        let mut ys = ys.map(|y| y.chunks_exact_mut(LANES));
        for block in 0..self.head_dim / LANES {
            let first = head * self.head_dim / LANES + block;
            let values = blocks
                .get(first..)
                .unwrap_or(&[])
                .iter()
                .step_by(width / LANES);
            let mut sums = [[0.0; LANES]; Q];
            weigh_block(values, p, &mut sums);
            for ((y, sum), scale) in ys.iter_mut().zip(&sums).zip(scale) {
                for (y, sum) in y.next().unwrap_or(&mut []).iter_mut().zip(sum) {
                    *y = sum * scale;
                }
            }
        }
    }

    /// The same for heads that are no whole number of blocks; element by element, in the same order.
    fn weigh_uneven<const Q: usize>(
        &self,
        head: usize,
        p: [&[f32]; Q],
        scale: [f32; Q],
        ys: [&mut [f32]; Q],
    ) {
        let width = self.heads * self.head_dim;
        for ((y, p), scale) in ys.into_iter().zip(p).zip(scale) {
            for (i, y) in y.iter_mut().enumerate() {
                let column = self
                    .cache_v
                    .iter()
                    .skip(head * self.head_dim + i)
                    .step_by(width);
                *y = column.zip(p).fold(0.0, |sum, (&v, &p)| sum + p * v) * scale;
            }
        }
    }
}

/// `sums[i] += p[i][r] * values[r]` for as many rows as `p[i]` has.
#[inline(always)]
fn weigh_block<'v, const Q: usize>(
    mut values: impl Iterator<Item = &'v Block>,
    p: [&[f32]; Q],
    sums: &mut [Block; Q],
) {
    // The rows that all queries see; then what later queries see beyond.
    let shared = p.iter().map(|p| p.len()).min().unwrap_or(0);
    for (r, v) in values.by_ref().take(shared).enumerate() {
        for (sum, p) in sums.iter_mut().zip(p) {
            add_scaled(sum, p.get(r).copied().unwrap_or(0.0), v);
        }
    }
    for (r, v) in values.enumerate() {
        let mut seen = false;
        for (sum, p) in sums.iter_mut().zip(p) {
            if let Some(&p) = p.get(shared + r) {
                add_scaled(sum, p, v);
                seen = true;
            }
        }
        if !seen {
            return;
        }
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
