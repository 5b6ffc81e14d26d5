//! Lowers attention over the cache, and appending to it.

use lads_image::op::{Attention, Span};
use lads_kernels::attention_scratch_len;

use super::Lowering;
use super::compute::{Done, product};
use crate::graph::Id;

/// A row-wise view: first element, elements from one row to the next, and the whole span.
struct Rows {
    span: Span,
    stride: u32,
}

impl Lowering<'_, '_> {
    /// Returns the rows of a matrix, each contiguous.
    fn rows(&mut self, id: Id) -> Result<Rows, String> {
        let shape = self.shape(id)?;
        let view = self.view(id)?;
        let strided = view.buffer().is_some()
            && (shape[1] == 1 || view.strides[1] == 1)
            && view.strides[0] >= shape[1];
        if strided {
            return Ok(Rows {
                span: self.span(&view, view.reach(&shape)),
                stride: view.strides[0] as u32,
            });
        }
        Ok(Rows {
            span: self.contiguous(id)?,
            stride: shape[1] as u32,
        })
    }

    pub(super) fn attention(&mut self, id: Id, x: &[Id], layer: usize, scale: f32) -> Done {
        let shape = self.shape(id)?;
        let (queries, tokens) = (shape[0], self.shape(x[1])?[0]);
        let [q, k, v] = [self.rows(x[0])?, self.rows(x[1])?, self.rows(x[2])?];
        let y = self.allocate(id, &shape);
        let scratch = self.buffer(attention_scratch_len(
            queries,
            self.cache.heads,
            self.cache.capacity,
        ));
        let op = Attention {
            y: self.span(&y, product(&shape)),
            queries: queries as u32,
            scratch: self.buffers[scratch],
            scale,
            ..self.append(&k, &v, tokens, layer)
        };
        self.ops.push(
            Attention {
                q: q.span,
                q_stride: q.stride,
                ..op
            }
            .into(),
        );
        self.set(id, y);
        Ok(())
    }

    /// Appends to the cache without attending.
    pub(super) fn record(&mut self, k: Id, v: Id, layer: usize) -> Done {
        let tokens = self.shape(k)?[0];
        let (k, v) = (self.rows(k)?, self.rows(v)?);
        let op = self.append(&k, &v, tokens, layer);
        self.ops.push(op.into());
        Ok(())
    }

    fn append(&self, k: &Rows, v: &Rows, tokens: usize, layer: usize) -> Attention {
        let [cache_k, cache_v] = self.cache.spans(layer);
        let none = Span::default();
        Attention {
            q: none,
            q_stride: 0,
            k: k.span,
            k_stride: k.stride,
            v: v.span,
            v_stride: v.stride,
            y: none,
            format: self.cache.format,
            cache_k,
            cache_v,
            heads: self.cache.heads as u32,
            head_dim: self.cache.head_dim as u32,
            tokens: tokens as u32,
            queries: 0,
            scale: 1.0,
            scratch: none,
        }
    }
}
