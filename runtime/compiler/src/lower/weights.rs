//! Everything constant, in the order of first use, each content once.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;

use lads_core::op::WeightSpan;
use lads_kernels::{pack, packed_len};

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
    /// By content, as a hash: the places with that hash.
    places: HashMap<u64, Vec<WeightSpan>>,
    /// Tensors that were stored before. The tensor is kept, so that its address stays its own.
    stored: HashMap<(usize, Form), (Arc<Tensor>, WeightSpan)>,
}

impl Weights {
    /// Stores a tensor as it is.
    pub fn plain(&mut self, tensor: &Arc<Tensor>) -> Result<WeightSpan, String> {
        self.once(tensor, Form::Plain, |data| Ok(data.to_vec()))
    }

    /// Stores a `[k, n]` matrix in the panels that `Linear` reads.
    pub fn packed(&mut self, tensor: &Arc<Tensor>) -> Result<WeightSpan, String> {
        self.once(tensor, Form::Packed, |data| {
            let &[k, n] = &tensor.shape[..] else { return Err("has weights that are no matrix".into()) };
            let mut panels = vec![0.0; packed_len(k, n)];
            pack(data, k, n, &mut panels);
            Ok(panels)
        })
    }

    fn once(&mut self, tensor: &Arc<Tensor>, form: Form, make: impl FnOnce(&[f32]) -> Result<Vec<f32>, String>) -> Result<WeightSpan, String> {
        let key = (Arc::as_ptr(tensor).addr(), form);
        if let Some((_, span)) = self.stored.get(&key) {
            return Ok(*span);
        }
        let data = tensor.as_f32().ok_or("reads integers as numbers")?;
        let span = self.store(&make(data)?)?;
        self.stored.insert(key, (tensor.clone(), span));
        Ok(span)
    }

    /// Stores elements unless the same are there already.
    pub fn store(&mut self, data: &[f32]) -> Result<WeightSpan, String> {
        let bytes: &[u8] = bytemuck::cast_slice(data);
        let mut hasher = DefaultHasher::new();
        bytes.hash(&mut hasher);
        let hash = hasher.finish();
        let known = self.places.get(&hash).and_then(|spans| {
            let same = |span: &&WeightSpan| {
                let at = span.offset as usize;
                bytemuck::cast_slice::<f32, u8>(&self.data[at..at + span.len as usize]) == bytes
            };
            spans.iter().find(same)
        });
        if let Some(&span) = known {
            return Ok(span);
        }
        let start = self.data.len().next_multiple_of(ALIGN);
        if u32::try_from(start + data.len()).is_err() {
            return Err("has weights beyond 32-bit offsets".into());
        }
        self.data.resize(start, 0.0);
        self.data.extend_from_slice(data);
        let span = WeightSpan { offset: start as u32, len: data.len() as u32 };
        self.places.entry(hash).or_default().push(span);
        Ok(span)
    }
}
