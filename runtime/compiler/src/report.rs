//! Sizes of compiled programs.

use std::fmt;
use std::ops::Range;

use lads_image::op::WeightFormat;

/// One dense layer or convolution of a program.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LayerReport {
    /// Name of the ONNX node that the layer was made from, or of that node's first output.
    pub node: String,
    /// Number of weights.
    pub weights: usize,
    /// Storage format of the weights.
    pub format: WeightFormat,
    /// Range of 4-byte words that the layer takes in the image's weights. Layers of several
    /// programs may share them.
    pub words: Range<usize>,
}

/// One program of an image.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct ProgramReport {
    /// Name of the program, for example `high_level/record`.
    pub name: String,
    /// Name of the graph that it was compiled from; empty for a program that only copies.
    pub entry: String,
    /// Number of ops.
    pub ops: usize,
    /// Number of elements of arena that the memory plan needs.
    pub arena_len: usize,
    /// Lower bound of the arena: the largest sum of values that live at the same time.
    pub arena_lower_bound: usize,
    /// Dense layers and convolutions of the program, in their order; depthwise ones always have
    /// 32-bit floats.
    pub layers: Vec<LayerReport>,
}

/// Sizes of the programs that a compilation made.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct CompileReport {
    /// Programs, in the image's order.
    pub programs: Vec<ProgramReport>,
    /// Number of bytes of weights, tables and word embeddings, each content once.
    pub weight_bytes: usize,
    /// Number of 4-byte words of state that KV caches take.
    pub cache_len: usize,
}

impl CompileReport {
    /// Returns the number of elements of arena that the largest program needs.
    pub fn arena_len(&self) -> usize {
        self.programs
            .iter()
            .map(|program| program.arena_len)
            .max()
            .unwrap_or(0)
    }
}

/// Formats a table, one line per program.
impl fmt::Display for CompileReport {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(
            f,
            "{:<26} {:>5} {:>8} {:>8}",
            "program", "ops", "arena", "at least"
        )?;
        for program in &self.programs {
            writeln!(
                f,
                "{:<26} {:>5} {:>8} {:>8}",
                program.name, program.ops, program.arena_len, program.arena_lower_bound
            )?;
        }
        write!(
            f,
            "weights {} bytes, KV caches {} bytes",
            self.weight_bytes,
            self.cache_len * 4
        )
    }
}
