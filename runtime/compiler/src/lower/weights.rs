//! Everything constant, in the order of first use, each content once.
//!
//! Packed matrices are compared panel by panel, so that a matrix of which another program needs some columns only is stored once
//! too: the columns' panels lie one after the other inside it.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;

use lads_core::op::WeightSpan;
use lads_kernels::{PANEL, pack, packed_len};

use crate::tensor::Tensor;

/// Elements of a cache line: what each tensor starts at a multiple of.
const ALIGN: usize = 16;

/// How a tensor is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Form {
    Plain,
    Packed,
}

/// The weights of an image.
#[derive(Debug, Default)]
pub(crate) struct Weights {
    pub data: Vec<f32>,
    /// By content, as a hash: where blocks with that hash start.
    places: HashMap<u64, Vec<usize>>,
    /// Tensors that were stored before. The tensor is kept, so that its address stays its own.
    stored: HashMap<(usize, Form), (Arc<Tensor>, WeightSpan)>,
}

impl Weights {
    /// Stores a tensor as it is.
    pub fn plain(&mut self, tensor: &Arc<Tensor>) -> Result<WeightSpan, String> {
        let data = tensor.as_f32().ok_or("reads integers as numbers")?;
        self.once(tensor, Form::Plain, |this| this.store(data))
    }

    /// Stores a `[k, n]` matrix in the panels that `Linear` reads.
    pub fn packed(&mut self, tensor: &Arc<Tensor>) -> Result<WeightSpan, String> {
        let data = tensor.as_f32().ok_or("reads integers as numbers")?;
        let &[k, n] = &tensor.shape[..] else {
            return Err("has weights that are no matrix".into());
        };
        self.once(tensor, Form::Packed, |this| {
            let mut panels = vec![0.0; packed_len(k, n)];
            pack(data, k, n, &mut panels);
            this.store_blocks(&panels, k * PANEL)
        })
    }

    fn once(
        &mut self,
        tensor: &Arc<Tensor>,
        form: Form,
        store: impl FnOnce(&mut Self) -> Result<WeightSpan, String>,
    ) -> Result<WeightSpan, String> {
        let key = (Arc::as_ptr(tensor).addr(), form);
        if let Some((_, span)) = self.stored.get(&key) {
            return Ok(*span);
        }
        let span = store(self)?;
        self.stored.insert(key, (tensor.clone(), span));
        Ok(span)
    }

    /// Stores elements unless the same are there already.
    pub fn store(&mut self, data: &[f32]) -> Result<WeightSpan, String> {
        self.store_blocks(data, data.len())
    }

    /// The same, for data of which the tail from any multiple of `block` may be asked for later.
    fn store_blocks(&mut self, data: &[f32], block: usize) -> Result<WeightSpan, String> {
        let hash = |block: &[f32]| {
            let mut hasher = DefaultHasher::new();
            bytes(block).hash(&mut hasher);
            hasher.finish()
        };
        let block = block.max(1);
        let first = data.chunks(block).next().unwrap_or(&[]);
        let known = self
            .places
            .get(&hash(first))
            .into_iter()
            .flatten()
            .copied()
            .find(|&at| {
                let there = self.data.get(at..at + data.len());
                there.is_some_and(|there| bytes(there) == bytes(data))
            });
        let start = if let Some(known) = known {
            known
        } else {
            let start = self.data.len().next_multiple_of(ALIGN);
            if u32::try_from(start + data.len()).is_err() {
                return Err("has weights beyond 32-bit offsets".into());
            }
            self.data.resize(start, 0.0);
            self.data.extend_from_slice(data);
            for (i, block_data) in data.chunks(block).enumerate() {
                self.places
                    .entry(hash(block_data))
                    .or_default()
                    .push(start + i * block);
            }
            start
        };
        Ok(WeightSpan {
            offset: start as u32,
            len: data.len() as u32,
        })
    }
}

/// The bits of elements, so that zeros of different sign differ.
fn bytes(data: &[f32]) -> &[u8] {
    bytemuck::cast_slice(data)
}
