//! One compiled entry graph: a list of ops over spans, checked once, then run without looking back.
//!
//! Invariants of a [`Program`]: every op decodes, every span lies inside its space, every length is what the shape says, what
//! an op writes overlaps nothing that it reads (see [`op`](crate::op)), and every port lies inside the arena. Only
//! [`Program::new_checked`] makes one, so running can fail on one account alone: an index that the caller or the data chose.

use core::error::Error;
use core::fmt;

use crate::check::{Checker, Fault};
use crate::codec::{Field, Reader};
use crate::image::{PortRecord, ProgramRecord};
use crate::op::{OP_WORDS, Op, Place, Port, Span};

/// The spaces that a program's spans point into, in elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Spaces {
    /// Elements of weights in the image.
    pub weights_len: usize,
    /// Elements of state for the KV cache.
    pub cache_len: usize,
    /// The largest number of tokens in the cache when the program starts.
    pub past_max: usize,
}

/// A checked view on one program of an image.
#[derive(Debug, Clone, Copy)]
pub struct Program<'a> {
    ops: &'a [[u32; OP_WORDS]],
    record: &'a [u32],
    arena_len: u32,
    tokens: u32,
    cache_end: u64,
}

impl<'a> Program<'a> {
    /// Checks a program: its record and the ops that the record points at, of all `ops` of the image.
    pub fn new_checked(
        record: &'a [u32],
        ops: &'a [[u32; OP_WORDS]],
        spaces: Spaces,
    ) -> Result<Self, ProgramError> {
        let error = |op, fault| ProgramError { op, fault };
        let parsed =
            ProgramRecord::take(&mut Reader::new(record)).ok_or(error(None, Fault::Record))?;
        let first = parsed.first_op as usize;
        let ops = first
            .checked_add(parsed.ops_len as usize)
            .and_then(|end| ops.get(first..end))
            .ok_or(error(None, Fault::Bounds))?;
        let checker = Checker::new(spaces, parsed.arena_len, parsed.tokens);
        for (i, words) in ops.iter().enumerate() {
            let at = Some(i as u32);
            let op = Op::decode(words).ok_or(error(at, Fault::Encoding))?;
            checker.op(&op).map_err(|fault| error(at, fault))?;
        }
        for (ports, len) in [
            (&parsed.inputs, parsed.inputs_len),
            (&parsed.outputs, parsed.outputs_len),
        ] {
            let ports = ports
                .get(..len as usize)
                .ok_or(error(None, Fault::Record))?;
            for port in ports {
                checker.port(port).map_err(|fault| error(None, fault))?;
            }
        }
        let cache_end = checker.finish().map_err(|fault| error(None, fault))?;
        Ok(Self {
            ops,
            record,
            arena_len: parsed.arena_len,
            tokens: parsed.tokens,
            cache_end,
        })
    }

    /// Elements of the KV cache up to the end of what the program reads or appends.
    pub(crate) fn cache_end(&self) -> u64 {
        self.cache_end
    }

    /// Elements of arena that a run needs.
    pub fn arena_len(&self) -> usize {
        self.arena_len as usize
    }

    /// Tokens that a run appends to the KV cache.
    pub fn tokens(&self) -> usize {
        self.tokens as usize
    }

    /// True for a program that the image leaves out.
    pub fn is_empty(&self) -> bool {
        self.ops.is_empty()
    }

    /// The ops, in the order in which they run.
    pub fn ops(&self) -> impl Iterator<Item = Op> + 'a {
        // Decoded once already, with the zeros behind each.
        self.ops
            .iter()
            .filter_map(|words| Op::take(&mut Reader::new(words)))
    }

    /// The values that the caller sets before a run.
    pub fn inputs(&self) -> impl Iterator<Item = PortRecord> + 'a {
        ports(self.record, 4)
    }

    /// The values that are valid after a run.
    pub fn outputs(&self) -> impl Iterator<Item = PortRecord> + 'a {
        ports(
            self.record,
            4 + 1 + <[PortRecord; crate::image::PORTS]>::WORDS,
        )
    }

    /// Where an output lies.
    pub fn output(&self, port: Port) -> Option<Place> {
        self.outputs()
            .find(|output| output.port == port)
            .map(|output| output.place)
    }

    /// The arena span of an output.
    pub(crate) fn output_span(&self, port: Port) -> Option<Span> {
        match self.output(port)? {
            Place::Span(span) => Some(span),
            Place::Int(_) => None,
        }
    }
}

/// The ports of a record: their number at word `start`, then the ports.
fn ports(record: &[u32], start: usize) -> impl Iterator<Item = PortRecord> + '_ {
    let len = record.get(start).copied().unwrap_or(0);
    let mut from = Reader::new(record.get(start.saturating_add(1)..).unwrap_or(&[]));
    (0..len).map_while(move |_| PortRecord::take(&mut from))
}

/// Why a program was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ProgramError {
    /// The op, counted from the program's first; `None` for the program's record.
    pub op: Option<u32>,
    /// What is wrong.
    pub fault: Fault,
}

impl fmt::Display for ProgramError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self.op {
            Some(op) => write!(f, "op {op}: {}", self.fault),
            None => write!(f, "record: {}", self.fault),
        }
    }
}

impl Error for ProgramError {}
