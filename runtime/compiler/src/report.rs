//! Sizes of what was compiled.

use std::fmt;
use std::ops::Range;

use lads_image::op::WeightFormat;

/// One dense layer of a program.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LayerReport {
    /// Name of the ONNX node that it was made from, or of that node's first output.
    pub node: String,
    /// Number of weights.
    pub weights: usize,
    /// How they are stored.
    pub format: WeightFormat,
    /// Where: the 4-byte words of the image's weights. Layers of several programs may share them.
    pub words: Range<usize>,
}

/// One program of an image.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct ProgramReport {
    /// For example `high_level/record`.
    pub name: String,
    /// The graph it was compiled from; empty for one that only copies.
    pub entry: String,
    /// Number of ops.
    pub ops: usize,
    /// Elements of arena that the memory plan needs.
    pub arena_len: usize,
    /// Largest sum of values that live at the same time: no plan needs less.
    pub arena_lower_bound: usize,
    /// Its dense layers, in their order.
    pub layers: Vec<LayerReport>,
}

/// What a compilation made.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct CompileReport {
    /// The programs, in the image's order.
    pub programs: Vec<ProgramReport>,
    /// Bytes of weights, tables and word embeddings, each content once.
    pub weight_bytes: usize,
    /// 4-byte words of state that KV caches take.
    pub cache_len: usize,
}

impl CompileReport {
    /// Elements of arena that the largest program needs.
    pub fn arena_len(&self) -> usize {
        self.programs
            .iter()
            .map(|program| program.arena_len)
            .max()
            .unwrap_or(0)
    }
}

/// A table, one line per program.
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
