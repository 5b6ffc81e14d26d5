//! Attention over the KV cache, which it appends to.

use lads_kernels as kernels;
use lads_kernels::attention_scratch_len;

use super::{Operation, Work};
use crate::access::{self, Access, AccessKind};
use crate::check::{Checked, Checker, Fault, apart, exactly, overlap, require};
use crate::codec::{record, word_enum_for};
use crate::machine::{ExecError, Machine};
use crate::place::{Span, StateSpan};

pub use lads_kernels::CacheFormat;

word_enum_for!(CacheFormat { F32 = 0, F16 = 1, Int8 = 2, });

record! {
    /// Causal multi-head attention over the KV cache, which it appends to.
    ///
    /// The `tokens` rows of `k` and `v` become cache rows `P..P + tokens` (one contiguous row of
    /// `heads * head_dim` per token). Then each of the last `queries` tokens attends to rows `0..=`
    /// its own: `y[i] = concat over heads of softmax(scale * q[i]·K^T)·V`. With `queries = 0` the
    /// op only appends to the cache; then `q`, `y` and `scratch` are empty spans. All attentions of
    /// a program append the same number of tokens, and the caller advances `P` after the whole
    /// program ran. `capacity` is the number of rows of the entry's KV state; its spans are
    /// relative to that state.
    pub struct Attention {
        /// First of the `queries` query rows; row `i` starts at `offset + i * q_stride`. Length
        /// `(queries - 1) * q_stride + heads * head_dim`.
        pub q: Span,
        /// Elements from one query row to the next.
        pub q_stride: u32,
        /// First of the `tokens` key rows; length `(tokens - 1) * k_stride + heads * head_dim`.
        pub k: Span,
        /// Elements from one key row to the next.
        pub k_stride: u32,
        /// First of the `tokens` value rows; length `(tokens - 1) * v_stride + heads * head_dim`.
        pub v: Span,
        /// Elements from one value row to the next.
        pub v_stride: u32,
        /// Result `[queries, heads * head_dim]`, contiguous.
        pub y: Span,
        /// Storage format of the cache.
        pub format: CacheFormat,
        /// Cached keys `[capacity / 16, heads * head_dim, 16]`, blocks of 16 tokens, the last one
        /// whole: `lads_kernels::keys_len` elements of `format`, then their scales, if it has any:
        /// `CacheFormat::words`.
        pub cache_k: StateSpan,
        /// Cached values `[capacity, heads * head_dim]`, elements of `format`, then their scales;
        /// does not overlap `cache_k`.
        pub cache_v: StateSpan,
        /// Number of heads.
        pub heads: u32,
        /// Number of elements per head.
        pub head_dim: u32,
        /// Number of tokens that the op appends.
        pub tokens: u32,
        /// Number of appended tokens, the last ones, that are also queries.
        pub queries: u32,
        /// Factor of the scores before the softmax.
        pub scale: f32,
        /// Scratch memory of `lads_kernels::attention_scratch_len(queries, heads, capacity)`
        /// elements, overlaps nothing.
        pub scratch: Span,
    }
}

impl Operation for Attention {
    fn check(&self, checker: &Checker) -> Checked {
        require(
            self.tokens == checker.tokens && self.queries <= self.tokens,
            Fault::Tokens,
        )?;
        let width = u64::from(self.heads).saturating_mul(u64::from(self.head_dim));
        let width = u32::try_from(width).map_err(|_| Fault::Shape)?;
        for (span, stride) in [(self.k, self.k_stride), (self.v, self.v_stride)] {
            checker.arena(span)?;
            rows(span, self.tokens, stride, width)?;
        }
        let built = match self.format {
            CacheFormat::F32 => true,
            CacheFormat::F16 => cfg!(feature = "half-cache"),
            CacheFormat::Int8 => cfg!(feature = "integer-cache"),
        };
        require(built, Fault::LeftOut)?;
        checker.cache(self.cache_k)?;
        checker.cache(self.cache_v)?;
        let caches = [self.cache_k, self.cache_v].map(|span| [span.offset, span.len]);
        require(!overlap(caches[0], caches[1]), Fault::Overlap)?;
        let capacity = u32::try_from(checker.spaces.rows).map_err(|_| Fault::Capacity)?;
        require(self.tokens <= capacity, Fault::Capacity)?;
        let heads = [self.heads as usize, self.head_dim as usize];
        let words = self.format.words(capacity as usize, heads);
        let [keys, values] = words.ok_or(Fault::Capacity)?;
        require(values == self.cache_v.len as usize, Fault::Capacity)?;
        require(keys == self.cache_k.len as usize, Fault::Shape)?;
        if self.queries == 0 {
            let empty = self.q.len == 0 && self.y.len == 0 && self.scratch.len == 0;
            return require(empty, Fault::Shape);
        }
        checker.arena(self.q)?;
        checker.arena(self.y)?;
        checker.arena(self.scratch)?;
        rows(self.q, self.queries, self.q_stride, width)?;
        exactly(self.y.len, [self.queries, width])?;
        let scratch = attention_scratch_len(
            self.queries as usize,
            self.heads as usize,
            capacity as usize,
        );
        require(scratch as u64 == u64::from(self.scratch.len), Fault::Shape)?;
        apart(self.y, [self.q, self.k, self.v, self.scratch])?;
        apart(self.scratch, [self.q, self.k, self.v])
    }

    #[inline]
    fn run(&self, _weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let past = machine.past;
        let (heads, head_dim) = (self.heads as usize, self.head_dim as usize);
        let width = heads.checked_mul(head_dim).ok_or(ExecError::Span)?;
        let [keys, values] = machine
            .cache
            .get_disjoint_mut([self.cache_k.range(), self.cache_v.range()])
            .map_err(|_| ExecError::Span)?;
        // Casts of whole words to smaller numbers: they fail on no span.
        #[cfg(feature = "half-cache")]
        let cast = |_| ExecError::Span;
        let mut cache = match self.format {
            CacheFormat::F32 => kernels::CacheMut::F32 { keys, values },
            #[cfg(feature = "half-cache")]
            CacheFormat::F16 => kernels::CacheMut::F16 {
                keys: bytemuck::try_cast_slice_mut(keys).map_err(cast)?,
                values: bytemuck::try_cast_slice_mut(values).map_err(cast)?,
            },
            #[cfg(feature = "integer-cache")]
            CacheFormat::Int8 => {
                let scales = self.scales() as usize;
                kernels::CacheMut::Int8 {
                    keys: split(keys, scales)?,
                    values: split(values, scales)?,
                }
            }
            #[allow(unreachable_patterns, reason = "it is left out or not")]
            _ => return Err(ExecError::Span),
        };
        let row = |span: Span| machine.arena.get(span.range()).ok_or(ExecError::Span);
        let append = kernels::Append {
            k: row(self.k)?,
            k_stride: self.k_stride as usize,
            v: row(self.v)?,
            v_stride: self.v_stride as usize,
            width,
            heads,
            first: past,
        };
        append.run(machine.isa, &mut cache);
        if self.queries == 0 {
            return Ok(());
        }
        let [q, y, scratch] = machine
            .arena
            .get_disjoint_mut([self.q.range(), self.y.range(), self.scratch.range()])
            .map_err(|_| ExecError::Span)?;
        let attention = kernels::Attention {
            heads,
            head_dim,
            scale: self.scale,
            q_stride: self.q_stride as usize,
            visible: past
                .saturating_add(self.tokens as usize)
                .saturating_sub(self.queries as usize)
                .saturating_add(1),
            cache: cache.as_ref(),
        };
        attention.run(machine.isa, q, y, scratch);
        Ok(())
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        see(Access::rows(
            AccessKind::Read,
            self.k,
            self.tokens,
            self.k_stride,
        ));
        see(Access::rows(
            AccessKind::Read,
            self.v,
            self.tokens,
            self.v_stride,
        ));
        if self.queries > 0 {
            see(Access::rows(
                AccessKind::Read,
                self.q,
                self.queries,
                self.q_stride,
            ));
            access::write(self.scratch, see);
            access::write(self.y, see);
        }
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        for span in [
            &mut self.q,
            &mut self.k,
            &mut self.v,
            &mut self.y,
            &mut self.scratch,
        ] {
            access::visit_span(span, visit);
        }
    }

    fn work(&self) -> Work {
        let width = self.heads.saturating_mul(self.head_dim);
        let appended = Work::products([self.tokens, width, 2]).multiply_adds;
        if self.queries == 0 {
            let words = appended.div_ceil(self.format.per_word() as u64);
            return Work {
                state_words: words,
                ..Work::default()
            };
        }
        let values = u64::from(self.cache_v.len)
            .saturating_sub(self.scales())
            .saturating_mul(self.format.per_word() as u64);
        Work {
            // Scores, then the values that they weigh.
            multiply_adds: values.saturating_mul(2).saturating_mul(self.queries.into()),
            weight_words: 0,
            state_words: u64::from(self.cache_k.len).saturating_add(self.cache_v.len.into()),
        }
    }
}

/// Splits the words of keys or values into integers and so many scales.
#[cfg(feature = "integer-cache")]
fn split(words: &mut [f32], scales: usize) -> Result<kernels::ScaledMut<'_>, ExecError> {
    let integers = words.len().checked_sub(scales).ok_or(ExecError::Span)?;
    let (integers, scales) = words
        .split_at_mut_checked(integers)
        .ok_or(ExecError::Span)?;
    let integers = bytemuck::try_cast_slice_mut(integers).map_err(|_| ExecError::Span)?;
    Ok(kernels::ScaledMut { integers, scales })
}

impl Attention {
    /// Returns the number of scales of the keys, and of the values: those of `r` rows of keys take
    /// four bytes a head beside a byte for each element.
    fn scales(&self) -> u64 {
        match self.format {
            CacheFormat::F32 | CacheFormat::F16 => 0,
            CacheFormat::Int8 => {
                let [heads, head_dim] = [self.heads, self.head_dim].map(u64::from);
                let of_row = heads.saturating_mul(head_dim.saturating_add(4));
                let bytes = u64::from(self.cache_k.len).saturating_mul(4);
                let rows = bytes.checked_div(of_row).unwrap_or(0);
                rows.saturating_mul(heads)
            }
        }
    }
}

/// Checks that a span holds `rows` rows of `width` elements that start `stride` elements apart.
fn rows(span: Span, rows: u32, stride: u32, width: u32) -> Checked {
    let len = u64::from(rows.saturating_sub(1))
        .saturating_mul(u64::from(stride))
        .saturating_add(u64::from(width));
    let apart = rows == 1 || stride >= width;
    require(
        rows != 0 && width != 0 && apart && len == u64::from(span.len),
        Fault::Shape,
    )
}
