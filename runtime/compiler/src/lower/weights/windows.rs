//! Stores the weights of convolutions.

use std::sync::Arc;

use lads_image::op::{WeightFormat, WeightSpan};
use lads_kernels::{
    conv_integers_len, conv_integers_pack, conv_pack, conv_packed_len, conv_scale, depthwise_pack,
    depthwise_packed_len, stored,
};

use super::{Form, Weights, is_uneven, matrix, squares, words};
use crate::tensor::Tensor;

/// A matrix of a convolution in integers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Integers {
    /// The panels of each group of outputs in turn, all of the same length.
    pub w: WeightSpan,
    /// Scales and bias of each group of outputs in turn.
    pub columns: WeightSpan,
}

impl Weights<'_> {
    /// Stores the `[k, n]` matrix of a convolution for the kernel `Conv`: the panels of each group
    /// of outputs in turn, all of the same length.
    pub fn windows(&mut self, tensor: &Arc<Tensor>, groups: usize) -> Result<WeightSpan, String> {
        let (data, [k, all]) = matrix(tensor)?;
        self.once(tensor, Form::Windows(groups), |this| {
            let n = all / groups;
            let len = conv_packed_len([k, n]);
            let mut panels = vec![0.0; groups * len];
            for (i, panels) in panels.chunks_mut(len).enumerate() {
                conv_pack(&group(data, all, [i, n]), [k, n], panels);
            }
            this.store(&panels)
        })
    }

    /// Returns the format of the weights of a convolution of `channels` input channels that was made
    /// from `node`: an integer format or 32-bit floats.
    pub fn format_of_windows(
        &self,
        tensor: &Tensor,
        channels: usize,
        node: &str,
    ) -> Result<WeightFormat, String> {
        let (data, [_, n]) = matrix(tensor)?;
        let mut inputs = vec![0.0; channels];
        for (l, squares) in squares(data, n).into_iter().enumerate() {
            inputs[l % channels] += squares;
        }
        let asked = self.storage.of(self.entry, node);
        // All channels of an image have one step.
        Ok(if asked.is_scaled() && !is_uneven(inputs) {
            asked
        } else {
            WeightFormat::F32
        })
    }

    /// Stores the `[k, n]` matrix of a convolution, and its bias, for the kernel `IntegerConv`, whose
    /// pixels read runs of `len` inputs.
    pub fn integers(
        &mut self,
        [tensor, bias]: [&Arc<Tensor>; 2],
        format: WeightFormat,
        [groups, len]: [usize; 2],
    ) -> Result<Integers, String> {
        let bias = bias.as_f32().ok_or("reads integers as numbers")?;
        let (data, [k, all]) = matrix(tensor)?;
        let n = all / groups;
        let scales: Vec<f32> = (0..all)
            .map(|j| conv_scale(format, data.iter().skip(j).step_by(all).copied(), len))
            .collect();
        let of_groups = scales.chunks(n).zip(bias.chunks(n));
        let columns: Vec<f32> = of_groups
            .flat_map(|(scales, bias)| [scales, bias].concat())
            .collect();
        // The columns come first: they are read once per panel.
        let columns = self.store(&columns)?;
        let runs = [k / len, len];
        let w = self.once(tensor, Form::Integers(format, [groups, len]), |this| {
            let groups = [groups, n];
            let words = if format == WeightFormat::Int8 {
                words(&quantised(data, &scales, groups, runs, stored::to_int8))
            } else {
                words(&quantised(data, &scales, groups, runs, stored::to_int16))
            };
            this.store(&words)
        })?;
        Ok(Integers { w, columns })
    }

    /// Stores the `[kernel, c]` matrix of a convolution for the kernel `Depthwise`.
    pub fn channels(&mut self, tensor: &Arc<Tensor>) -> Result<WeightSpan, String> {
        let (data, [kernel, c]) = matrix(tensor)?;
        self.once(tensor, Form::Channels, |this| {
            let mut packed = vec![0.0; depthwise_packed_len([kernel, c])];
            depthwise_pack(data, [kernel, c], &mut packed);
            this.store(&packed)
        })
    }
}

/// Returns the `n` columns of group `i` of a matrix with `all` columns.
fn group(data: &[f32], all: usize, [i, n]: [usize; 2]) -> Vec<f32> {
    data.chunks(all)
        .flat_map(|row| &row[i * n..][..n])
        .copied()
        .collect()
}

/// Quantises the matrix of a convolution, whose columns have `scales`, and packs it group by group.
fn quantised<T: Copy + Default>(
    data: &[f32],
    scales: &[f32],
    [groups, n]: [usize; 2],
    runs: [usize; 2],
    to: fn(f32, f32) -> T,
) -> Vec<T> {
    let len = conv_integers_len(runs, n);
    let mut panels = vec![T::default(); groups * len];
    for (i, panels) in panels.chunks_mut(len).enumerate() {
        let scales = scales[i * n..][..n].iter().cycle();
        let own: Vec<T> = group(data, groups * n, [i, n])
            .into_iter()
            .zip(scales)
            .map(|(w, &scale)| to(w, scale))
            .collect();
        conv_integers_pack(&own, runs, n, panels);
    }
    panels
}
