//! One compiled entry graph: a list of ops over spans, checked once, then run without further
//! checks.
//!
//! Invariants of a [`Program`]: every op decodes, every span lies inside its space, every length
//! matches the shape, no written span overlaps one that is read (see [`op`](crate::op)), and every
//! port lies inside the arena. Only [`Program::new_checked`] makes one, so a run can fail in two
//! ways only: by an index that the caller or the data chose, and by a KV cache without room.

use core::error::Error;
use core::fmt;

use lads_kernels::flushed;

use crate::check::{Checker, Fault, Spaces};
use crate::codec::Reader;
use crate::machine::{ExecError, Machine};
use crate::op::{OP_WORDS, Op, Work};
use crate::place::Place;

/// A checked view on one program of an image.
#[derive(Debug, Clone, Copy)]
pub struct Program<'a> {
    ops: &'a [[u32; OP_WORDS]],
    arena_len: u32,
    tokens: u32,
    rows: usize,
    cache_end: u64,
}

impl<'a> Program<'a> {
    /// Checks the ops of a program and the places of its ports. A run of the program appends
    /// `tokens` rows to the KV cache.
    pub fn new_checked(
        ops: &'a [[u32; OP_WORDS]],
        arena_len: u32,
        tokens: u32,
        spaces: Spaces,
        ports: impl Iterator<Item = Place>,
    ) -> Result<Self, ProgramError> {
        let error = |op, fault| ProgramError { op, fault };
        let checker = Checker::new(spaces, arena_len, tokens);
        for (i, words) in ops.iter().enumerate() {
            let at = Some(i as u32);
            let op = Op::decode(words).ok_or_else(|| {
                let left_out = Op::is_left_out(words);
                error(
                    at,
                    if left_out {
                        Fault::LeftOut
                    } else {
                        Fault::Encoding
                    },
                )
            })?;
            op.check(&checker).map_err(|fault| error(at, fault))?;
        }
        for port in ports {
            checker.place(port).map_err(|fault| error(None, fault))?;
        }
        let cache_end = checker.finish().map_err(|fault| error(None, fault))?;
        Ok(Self {
            ops,
            arena_len,
            tokens,
            rows: spaces.rows,
            cache_end,
        })
    }

    /// Makes a view without checks, for ops that [`new_checked`](Self::new_checked) has already
    /// checked in these spaces.
    #[inline]
    pub fn trusted(ops: &'a [[u32; OP_WORDS]], arena_len: u32, tokens: u32, rows: usize) -> Self {
        Self {
            ops,
            arena_len,
            tokens,
            rows,
            cache_end: u64::from(tokens),
        }
    }

    /// Runs the ops, treating subnormal numbers as zero. The ports' values are in the machine: set
    /// the inputs before the run, read the results afterwards.
    pub fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let needed = machine.past.saturating_add(self.tokens());
        if self.cache_end > 0 && needed > self.rows {
            return Err(ExecError::Full {
                rows: self.rows,
                needed,
            });
        }
        // Read in line, not through `ops`: a call and a copy per op show in the time of small programs.
        flushed(|| {
            for words in self.ops {
                if let Some(op) = Op::take(&mut Reader::new(words)) {
                    op.run(weights, machine)?;
                }
            }
            Ok(())
        })
    }

    /// Returns the number of words of the KV cache up to the end of the part that the program reads
    /// or appends; 0 for a program without a cache.
    #[inline]
    pub fn cache_end(&self) -> u64 {
        self.cache_end
    }

    /// Returns the number of elements of arena that a run needs.
    #[inline]
    pub fn arena_len(&self) -> usize {
        self.arena_len as usize
    }

    /// Returns the number of tokens that a run appends to the KV cache.
    #[inline]
    pub fn tokens(&self) -> usize {
        self.tokens as usize
    }

    /// Returns true for a program without ops.
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.ops.is_empty()
    }

    /// Returns the ops, in the order in which they run.
    #[inline]
    pub fn ops(&self) -> impl Iterator<Item = Op> + 'a {
        // Decoded once already, with the zeros after each op.
        self.ops.iter().filter_map(Op::decode)
    }

    /// Returns the cost of a run at the largest context.
    pub fn work(&self) -> Work {
        self.ops()
            .fold(Work::default(), |sum, op| sum.and(op.work()))
    }
}

/// Reason why a program was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ProgramError {
    /// Index of the op in the program; `None` for its ports and the length of its arena.
    pub op: Option<u32>,
    /// Fault of the op or program.
    pub fault: Fault,
}

impl fmt::Display for ProgramError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self.op {
            Some(op) => write!(f, "op {op}: {}", self.fault),
            None => self.fault.fmt(f),
        }
    }
}

impl Error for ProgramError {}
