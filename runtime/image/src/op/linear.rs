//! Dense layer: packed weights in any of their formats, bias, activation, residual connection.

use lads_kernels as kernels;

use super::{Operation, Work};
use crate::access::{self, Access, AccessKind};
use crate::check::{Checked, Checker, Fault, exactly, require};
use crate::codec::{Field, Reader, Writer, record, word_enum_for};
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{Span, WeightSpan};

pub use lads_kernels::{Activation, WeightFormat};

impl Field for Activation {
    const WORDS: usize = 2;
    fn put(&self, out: &mut Writer) {
        let (kind, alpha) = match *self {
            Self::None => (0, 0.0),
            Self::Relu => (1, 0.0),
            Self::LeakyRelu(alpha) => (2, alpha),
            Self::Tanh => (3, 0.0),
            Self::Sigmoid => (4, 0.0),
            Self::Elu(alpha) => (5, alpha),
            Self::Softplus => (6, 0.0),
            Self::Mish => (7, 0.0),
            Self::Clipped(bound) => (8, bound),
        };
        out.word(kind);
        alpha.put(out);
    }
    #[expect(
        clippy::inline_always,
        reason = "out of line it keeps the whole record in memory, and the loop over a program takes 2 KB more"
    )]
    #[inline(always)]
    fn take(from: &mut Reader) -> Option<Self> {
        let kind = from.word()?;
        let alpha = f32::take(from)?;
        let plain = match kind {
            0 => Self::None,
            1 => Self::Relu,
            2 => return Some(Self::LeakyRelu(alpha)),
            3 => Self::Tanh,
            4 => Self::Sigmoid,
            5 => return Some(Self::Elu(alpha)),
            6 => Self::Softplus,
            7 => Self::Mish,
            8 => return Some(Self::Clipped(alpha)),
            _ => return None,
        };
        (alpha.to_bits() == 0).then_some(plain)
    }
}

/// Returns whether this build has the kernels of a format.
pub(super) const fn is_built(format: WeightFormat) -> bool {
    match format {
        WeightFormat::F32 => true,
        WeightFormat::F16 | WeightFormat::Bf16 => cfg!(feature = "half-weights"),
        WeightFormat::Int8 | WeightFormat::Int16 => cfg!(feature = "integer-weights"),
    }
}

word_enum_for!(WeightFormat { F32 = 0, F16 = 1, Bf16 = 2, Int8 = 3, Int16 = 4, });

record! {
    /// Dense layer `y = (accumulate ? y : 0) + activation(x·W + b)`; with `accumulate` the op is in
    /// place on `y`: a residual connection.
    pub struct Linear {
        /// Input `[m, k]`, contiguous.
        pub x: Span,
        /// Storage format of `w`.
        pub format: WeightFormat,
        /// Weights `[k, n]` in panels of 64 outputs: `lads_kernels::packed_len` elements of
        /// `format`, ordered by `lads_kernels::pack`.
        pub w: WeightSpan,
        /// Factors `[n]` of the outputs of `x·W`, for integer formats only.
        pub scales: Option<WeightSpan>,
        /// Bias `[n]`.
        pub bias: Option<WeightSpan>,
        /// Result `[m, n]`, contiguous.
        pub y: Span,
        /// Number of rows.
        pub m: u32,
        /// Number of inputs.
        pub k: u32,
        /// Number of outputs.
        pub n: u32,
        /// Activation, applied to `x·W + b`, before accumulation.
        pub activation: Activation,
        /// True if the result is added to `y`.
        pub accumulate: bool,
    }
}

impl Operation for Linear {
    fn check(&self, checker: &Checker) -> Checked {
        checker.result(self.y, self.x.into())?;
        exactly(self.x.len, [self.m, self.k])?;
        exactly(self.y.len, [self.m, self.n])?;
        checker.weights(self.w)?;
        require(is_built(self.format), Fault::LeftOut)?;
        let scaled = self.format.is_scaled();
        require(self.scales.is_some() == scaled, Fault::Shape)?;
        // Blocks of sixteen outputs, and of integers of sixteen inputs, four bytes to a word.
        let [inputs, times] = if scaled {
            [self.k.div_ceil(16), 16]
        } else {
            [self.k, 1]
        };
        let bytes = self.format.bytes() as u32;
        exactly(self.w.len, [self.n.div_ceil(16), inputs, times, 4, bytes])?;
        for column in [self.scales, self.bias].into_iter().flatten() {
            checker.weights(column)?;
            exactly(column.len, [self.n])?;
        }
        Ok(())
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let isa = machine.isa;
        let (read, y) = Readable::cut(weights, machine.arena, self.y)?;
        let bias = match self.bias {
            Some(bias) => read.get(bias.into())?,
            None => &[],
        };
        #[cfg(feature = "integer-weights")]
        let scales = match self.scales {
            Some(scales) => read.get(scales.into())?,
            None => &[],
        };
        let w = read.get(self.w.into())?;
        // Casts of whole words to smaller numbers: they fail on no span.
        #[cfg(any(feature = "half-weights", feature = "integer-weights"))]
        let cast = |_| ExecError::Span;
        let w = match self.format {
            WeightFormat::F32 => kernels::Panels::F32(w),
            #[cfg(feature = "half-weights")]
            WeightFormat::F16 => kernels::Panels::F16(bytemuck::try_cast_slice(w).map_err(cast)?),
            #[cfg(feature = "half-weights")]
            WeightFormat::Bf16 => kernels::Panels::Bf16(bytemuck::try_cast_slice(w).map_err(cast)?),
            #[cfg(feature = "integer-weights")]
            WeightFormat::Int8 => kernels::Panels::Int8 {
                panels: bytemuck::try_cast_slice(w).map_err(cast)?,
                scales,
            },
            #[cfg(feature = "integer-weights")]
            WeightFormat::Int16 => kernels::Panels::Int16 {
                panels: bytemuck::try_cast_slice(w).map_err(cast)?,
                scales,
            },
            #[allow(unreachable_patterns, reason = "there is something left out or not")]
            _ => return Err(ExecError::Span),
        };
        let layer = kernels::Linear {
            k: self.k as usize,
            n: self.n as usize,
            w,
            bias,
            activation: self.activation,
            accumulate: self.accumulate,
        };
        layer.run(isa, read.get(self.x.into())?, y);
        Ok(())
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        see(Access::all(AccessKind::Read, self.x));
        if self.accumulate {
            see(Access::all(AccessKind::Read, self.y));
        }
        access::write(self.y, see);
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_span(&mut self.x, visit);
        access::visit_span(&mut self.y, visit);
    }

    fn work(&self) -> Work {
        let columns = [self.scales, self.bias].into_iter().flatten();
        Work::products([self.m, self.k, self.n]).with_weights([self.w].into_iter().chain(columns))
    }
}

#[cfg(test)]
mod tests {
    use std::vec;

    use super::{Activation, Linear, WeightFormat};
    use crate::op::tests::{computed, span};
    use crate::place::WeightSpan;

    #[test]
    fn the_activation_comes_before_the_residual_connection() {
        let mut weights = vec![0.0; lads_kernels::packed_len(WeightFormat::F32, [2, 1])];
        lads_kernels::pack(WeightFormat::F32, &[1.0, -2.0], [2, 1], &mut weights);
        let len = weights.len() as u32;
        weights.push(0.5);
        let layer = Linear {
            x: span(0, 4),
            format: WeightFormat::F32,
            w: WeightSpan { offset: 0, len },
            scales: None,
            bias: Some(WeightSpan {
                offset: len,
                len: 1,
            }),
            y: span(4, 2),
            m: 2,
            k: 2,
            n: 1,
            activation: Activation::Relu,
            accumulate: true,
        };
        let arena = [3.0, 1.0, 1.0, 3.0, 10.0, 20.0];
        assert_eq!(computed(layer, &arena, &weights)[4..], [11.5, 20.0]);
        let layer = Linear {
            accumulate: false,
            ..layer
        };
        assert_eq!(computed(layer, &arena, &weights)[4..], [1.5, 0.0]);
    }
}
