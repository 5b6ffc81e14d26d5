//! Stores all constants, in the order of first use, each content once.
//!
//! Packed matrices are compared panel by panel, so that a matrix is stored once even if another
//! program needs only some of its columns: the columns' panels are consecutive inside it.

mod windows;

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;

use bytemuck::NoUninit;
use lads_image::op::{WeightFormat, WeightSpan};
use lads_kernels::{PANEL, pack, packed_len, stored};

use crate::storage::Storage;
use crate::tensor::Tensor;

/// Alignment of each tensor in elements: a cache line.
const ALIGN: usize = 16;

/// Layout in which a tensor is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Form {
    Plain,
    Packed(WeightFormat),
    Scales(WeightFormat),
    /// Weights of a convolution, with this number of groups of outputs.
    Windows(usize),
    /// Integer weights of a convolution, with this number of groups of outputs, and of inputs in a
    /// run.
    Integers(WeightFormat, [usize; 2]),
    /// Weights of a depthwise convolution.
    Channels,
}

/// A packed matrix.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Packed {
    pub format: WeightFormat,
    pub w: WeightSpan,
    /// Scales of the columns, for integer formats only.
    pub scales: Option<WeightSpan>,
}

/// The weights of an image.
#[derive(Debug)]
pub(crate) struct Weights<'s> {
    /// Storage format of matrices; all other constants are `f32`.
    storage: &'s Storage,
    /// Name of the entry graph whose layers are being stored.
    pub entry: &'s str,
    /// Stored words; formats with fewer bits have several elements in each.
    pub data: Vec<f32>,
    /// Starts of the stored blocks, by the hash of their content.
    places: HashMap<u64, Vec<usize>>,
    /// Tensors that were stored before. The tensor is kept, so that its address stays its own.
    stored: HashMap<(usize, Form), (Arc<Tensor>, WeightSpan)>,
}

impl<'s> Weights<'s> {
    /// Makes an empty store.
    pub fn new(storage: &'s Storage) -> Self {
        Self {
            storage,
            entry: "",
            data: vec![],
            places: HashMap::new(),
            stored: HashMap::new(),
        }
    }

    /// Stores a tensor as it is given.
    pub fn plain(&mut self, tensor: &Arc<Tensor>) -> Result<WeightSpan, String> {
        let data = tensor.as_f32().ok_or("reads integers as numbers")?;
        self.once(tensor, Form::Plain, |this| this.store(data))
    }

    /// Stores the `[k, n]` matrix of the layer that was made from `node`, in the panels that `Linear` reads.
    pub fn packed(&mut self, tensor: &Arc<Tensor>, node: &str) -> Result<Packed, String> {
        let (data, [k, n]) = matrix(tensor)?;
        // One step for inputs of any size would be too coarse for the small ones.
        let asked = self.storage.of(self.entry, node);
        let format = if asked.is_scaled() && is_uneven(squares(data, n)) {
            WeightFormat::F32
        } else {
            asked
        };
        let (w, scales) = match format {
            WeightFormat::F32 => (self.panels(tensor, format, [k, n], data)?, None),
            WeightFormat::F16 => {
                let halves = converted(data, format, stored::to_f16)?;
                (self.panels(tensor, format, [k, n], &halves)?, None)
            }
            WeightFormat::Bf16 => {
                let halves = converted(data, format, stored::to_bf16)?;
                (self.panels(tensor, format, [k, n], &halves)?, None)
            }
            WeightFormat::Int8 => {
                let scales: Vec<f32> = columns(data, n).map(stored::int8_scale).collect();
                self.scaled(tensor, format, [k, n], data, &scales, stored::to_int8)?
            }
            WeightFormat::Int16 => {
                let scales: Vec<f32> = columns(data, n).map(stored::int16_scale).collect();
                self.scaled(tensor, format, [k, n], data, &scales, stored::to_int16)?
            }
        };
        Ok(Packed { format, w, scales })
    }

    /// Stores panels as words; if another program needs only some columns of the matrix, the
    /// columns' panels are found again.
    fn panels<T: NoUninit + Default>(
        &mut self,
        tensor: &Arc<Tensor>,
        format: WeightFormat,
        [k, n]: [usize; 2],
        data: &[T],
    ) -> Result<WeightSpan, String> {
        self.once(tensor, Form::Packed(format), |this| {
            let mut panels = vec![T::default(); packed_len(format, [k, n])];
            pack(format, data, [k, n], &mut panels);
            this.store_blocks(
                &words(&panels),
                packed_len(format, [k, PANEL]) * size_of::<T>() / 4,
            )
        })
    }

    /// Quantises to integers, by the scales of the columns.
    fn scaled<T: NoUninit + Default>(
        &mut self,
        tensor: &Arc<Tensor>,
        format: WeightFormat,
        [k, n]: [usize; 2],
        data: &[f32],
        scales: &[f32],
        to: impl Fn(f32, f32) -> T,
    ) -> Result<(WeightSpan, Option<WeightSpan>), String> {
        let mut at = scales.iter().cycle();
        let integers = converted(data, format, |w| {
            let &scale = at.next()?;
            w.is_finite().then(|| to(w, scale))
        })?;
        // The scales come first, next to the bias: both are read once per panel.
        let scales = self.once(tensor, Form::Scales(format), |this| this.store(scales))?;
        let w = self.panels(tensor, format, [k, n], &integers)?;
        Ok((w, Some(scales)))
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

    /// Stores elements unless the same elements are stored already.
    pub fn store(&mut self, data: &[f32]) -> Result<WeightSpan, String> {
        self.store_blocks(data, data.len())
    }

    /// Stores data whose tail from any multiple of `block` may be asked for later, unless it is
    /// stored already.
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

/// Returns numbers of fewer bits as words.
fn words<T: NoUninit>(numbers: &[T]) -> Vec<f32> {
    bytemuck::cast_slice(numbers)
        .as_chunks::<4>()
        .0
        .iter()
        .map(|&word| f32::from_bits(u32::from_le_bytes(word)))
        .collect()
}

/// Returns the sum of the squared weights of each input of a `[k, n]` matrix.
fn squares(data: &[f32], n: usize) -> Vec<f32> {
    let squares = |row: &[f32]| row.iter().map(|w| w * w).sum();
    data.chunks(n.max(1)).map(squares).collect()
}

/// Returns whether a layer weights its inputs very differently, like a first layer whose inputs are
/// sensors, each in its own unit: some input has four times the root mean square of the median one.
fn is_uneven(mut inputs: Vec<f32>) -> bool {
    inputs.sort_by(f32::total_cmp);
    let median = inputs.get(inputs.len() / 2).copied().unwrap_or(0.0);
    inputs
        .last()
        .is_some_and(|&largest| largest > 16.0 * median)
}

/// Returns the columns of a matrix with `n` columns.
fn columns(data: &[f32], n: usize) -> impl Iterator<Item = impl Iterator<Item = f32>> {
    (0..n).map(move |j| data.iter().skip(j).step_by(n).copied())
}

/// Returns the elements and the shape of a matrix of weights.
fn matrix(tensor: &Tensor) -> Result<(&[f32], [usize; 2]), String> {
    let data = tensor.as_f32().ok_or("reads integers as numbers")?;
    let &[k, n] = &tensor.shape[..] else {
        return Err("has weights that are not a matrix".into());
    };
    if data.iter().any(|w| !w.is_finite()) {
        return Err("has weights that are not finite; train or export it again".into());
    }
    Ok((data, [k, n]))
}

/// Converts every weight to another format.
fn converted<T>(
    data: &[f32],
    format: WeightFormat,
    to: impl FnMut(f32) -> Option<T>,
) -> Result<Vec<T>, String> {
    let all: Option<Vec<T>> = data.iter().copied().map(to).collect();
    all.ok_or_else(|| {
        let largest = data.iter().fold(0.0_f32, |largest, w| largest.max(w.abs()));
        format!(
            "has weights up to {largest:e}, which {} cannot hold; compile with another format",
            format.name()
        )
    })
}

/// Returns the bits of elements, so that zeros of different sign differ.
fn bytes(data: &[f32]) -> &[u8] {
    bytemuck::cast_slice(data)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::{WeightFormat, Weights};
    use crate::storage::Storage;
    use crate::tensor::Tensor;

    /// Returns the format that is chosen for a `[k, 20]` matrix whose inputs have these weights.
    fn format(wanted: WeightFormat, inputs: &[f32]) -> WeightFormat {
        let data = inputs.iter().flat_map(|&w| [w; 20]).collect();
        let storage = Storage {
            weights: wanted,
            ..Storage::default()
        };
        let matrix = Arc::new(Tensor::f32(&[inputs.len(), 20], data));
        let stored = Weights::new(&storage).packed(&matrix, "layer");
        stored.unwrap().format
    }

    #[test]
    fn inputs_of_very_different_weight_keep_their_bits() {
        let (even, uneven) = ([0.1, -0.3, 0.2, 0.0, 0.39], [0.1, -0.3, 0.2, 0.0, 0.9]);
        for wanted in WeightFormat::ALL {
            assert_eq!(format(wanted, &even), wanted);
            let expected = if wanted.is_scaled() {
                WeightFormat::F32
            } else {
                wanted
            };
            assert_eq!(format(wanted, &uneven), expected);
        }
    }

    #[test]
    fn weights_that_are_not_finite_are_refused_in_every_format() {
        for w in [f32::NAN, f32::INFINITY] {
            let matrix = Arc::new(Tensor::f32(&[2, 1], vec![0.5, w]));
            for wanted in WeightFormat::ALL {
                let storage = Storage::of_weights(wanted);
                let mut weights = Weights::new(&storage);
                let error = weights.packed(&matrix, "layer").err().unwrap();
                assert!(error.contains("not finite"), "{error}");
                let error = weights.windows(&matrix, 1).err().unwrap();
                assert!(error.contains("not finite"), "{error}");
            }
        }
    }

    #[test]
    fn convolutions_take_integers_unless_their_channels_differ() {
        // Three channels, of which the last weighs most; a kernel of two pixels, of which one does.
        let matrix = |channels: [f32; 3], pixels: [f32; 2]| {
            let inputs = pixels
                .iter()
                .flat_map(|p| channels.iter().map(move |c| p * c));
            let data = inputs.flat_map(|w| [w, -w]).collect();
            Tensor::f32(&[6, 2], data)
        };
        for wanted in WeightFormat::ALL {
            let storage = Storage::of_weights(wanted);
            let weights = Weights::new(&storage);
            let format = |channels, pixels| {
                let found = weights.format_of_windows(&matrix(channels, pixels), 3, "conv");
                found.unwrap()
            };
            let stored = if wanted.is_scaled() {
                wanted
            } else {
                WeightFormat::F32
            };
            assert_eq!(format([0.1, -0.3, 0.2], [9.0, 0.1]), stored);
            assert_eq!(format([0.1, -0.1, 0.9], [1.0, 1.0]), WeightFormat::F32);
        }
    }
}
