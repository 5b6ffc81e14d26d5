//! A policy: the programs, the contract and the weights of one image, checked once.
//!
//! [`Policy::new_checked`] copies nothing and allocates nothing; the policy borrows the image. It proves what running relies
//! on: the sections lie inside the image, every program is well formed, every port has the contract's length, and the KV cache
//! holds the longest context. Nor can an image ask for memory that its own programs do not use. It does not read the weights: [`Policy::checksum_matches`] does.

use core::error::Error;
use core::fmt;

use crate::check::Fault;
use crate::codec::Field;
use crate::contract::{Contract, ContractError};
use crate::golden::Golden;
use crate::image::{
    self, CRC_WORD, HEADER_WORDS, PROGRAMS, PortRecord, ProgramKind, ProgramRecord,
    SECTION_TABLE_WORD, Section,
};
use crate::op::{OP_WORDS, Place, Port};
use crate::program::{Program, ProgramError, Spaces};

/// A checked view on a program image.
#[derive(Debug, Clone, Copy)]
pub struct Policy<'a> {
    image: &'a [u8],
    programs: [Program<'a>; PROGRAMS],
    contract: Contract<'a>,
    golden: Option<Golden<'a>>,
    weights: &'a [f32],
}

impl<'a> Policy<'a> {
    /// Opens an image that starts on a 4-byte boundary (64 is better); bytes after the image's own length are ignored.
    pub fn new_checked(image: &'a [u8]) -> Result<Self, PolicyError> {
        if cfg!(target_endian = "big") {
            return Err(PolicyError::BigEndian);
        }
        let total = total_bytes(image)?;
        let image = image.get(..total).ok_or(PolicyError::Truncated {
            got: image.len(),
            needed: total,
        })?;
        let words: &[u32] = bytemuck::try_cast_slice(image).map_err(|_| PolicyError::Alignment)?;
        let mut sections = Sections::new(words)?;
        let contract = sections.next(Section::Contract)?;
        let strings = bytemuck::try_cast_slice(sections.next(Section::Strings)?).ok();
        let strings = strings
            .and_then(|bytes| core::str::from_utf8(bytes).ok())
            .ok_or(PolicyError::Strings)?;
        let records = sections.next(Section::Programs)?;
        let (ops, rest) = sections.next(Section::Ops)?.as_chunks::<OP_WORDS>();
        if !rest.is_empty() || records.len() != PROGRAMS * ProgramRecord::WORDS {
            return Err(PolicyError::Section(Section::Programs));
        }
        let weights = sections.next(Section::Weights)?;
        let weights = bytemuck::try_cast_slice(weights)
            .map_err(|_| PolicyError::Section(Section::Weights))?;
        let golden = sections.next(Section::Golden)?;

        let contract =
            Contract::new_checked(contract, strings, weights).map_err(PolicyError::Contract)?;
        let golden = if golden.is_empty() {
            None
        } else {
            Some(
                Golden::new_checked(golden, &contract)
                    .ok_or(PolicyError::Section(Section::Golden))?,
            )
        };
        let mut records = records.chunks_exact(ProgramRecord::WORDS);
        let mut open = |kind| {
            let record = records.next().unwrap_or(&[]);
            open_program(kind, record, ops, &contract, weights.len())
        };
        let programs = [
            open(ProgramKind::Instruct)?,
            open(ProgramKind::Start)?,
            open(ProgramKind::StepDecide)?,
            open(ProgramKind::StepRecord)?,
            open(ProgramKind::Lookup)?,
            open(ProgramKind::Act)?,
            open(ProgramKind::Encode)?,
        ];
        let cache_end = programs.iter().map(Program::cache_end).max();
        if cache_end != Some(contract.cache_len() as u64) {
            return Err(PolicyError::Cache);
        }
        Ok(Self {
            image,
            programs,
            contract,
            golden,
            weights,
        })
    }

    /// What the policy expects and promises.
    pub fn contract(&self) -> Contract<'a> {
        self.contract
    }

    /// The recorded episode of the self-test, if the image holds one.
    pub fn golden(&self) -> Option<Golden<'a>> {
        self.golden
    }

    /// One of the programs; [`ProgramKind::Encode`] may be empty.
    pub fn program(&self, kind: ProgramKind) -> &Program<'a> {
        let [
            instruct,
            start,
            step_decide,
            step_record,
            lookup,
            act,
            encode,
        ] = &self.programs;
        match kind {
            ProgramKind::Instruct => instruct,
            ProgramKind::Start => start,
            ProgramKind::StepDecide => step_decide,
            ProgramKind::StepRecord => step_record,
            ProgramKind::Lookup => lookup,
            ProgramKind::Act => act,
            ProgramKind::Encode => encode,
        }
    }

    /// Everything constant that the programs read.
    pub fn weights(&self) -> &'a [f32] {
        self.weights
    }

    /// The image, without what lies behind it.
    pub fn image(&self) -> &'a [u8] {
        self.image
    }

    /// Bytes of the image.
    pub fn image_bytes(&self) -> usize {
        self.image.len()
    }

    /// Elements of scratch memory that a controller needs: the largest program's arena.
    pub fn arena_len(&self) -> usize {
        self.programs
            .iter()
            .map(Program::arena_len)
            .max()
            .unwrap_or(0)
    }

    /// Elements of memory that survive a control step: the KV cache, and twice (the state in force and the next one) the plan,
    /// the previous action and the logits.
    pub fn state_len(&self) -> usize {
        let [plan, action, logits] = self.bank_lens();
        let bank = plan.saturating_add(action).saturating_add(logits);
        self.contract
            .cache_len()
            .saturating_add(bank.saturating_mul(2))
    }

    /// Elements of a plan, an action and the logits.
    pub(crate) fn bank_lens(&self) -> [usize; 3] {
        [
            self.contract.plan_len(),
            self.contract.action_len(),
            self.contract.codebook_len(),
        ]
    }

    /// Reads the whole image and compares its checksum: true when not a bit of it has changed since it was compiled.
    pub fn checksum_matches(&self) -> bool {
        let stored = self
            .image
            .as_chunks::<4>()
            .0
            .get(CRC_WORD)
            .map(|&bytes| u32::from_le_bytes(bytes));
        stored == Some(image::crc32(self.image))
    }
}

/// The image's own length, from a header that is what it should be.
fn total_bytes(image: &[u8]) -> Result<usize, PolicyError> {
    let short = PolicyError::Truncated {
        got: image.len(),
        needed: HEADER_WORDS * 4,
    };
    let (words, _) = image.get(..HEADER_WORDS * 4).ok_or(short)?.as_chunks::<4>();
    let mut words = words.iter().map(|&bytes| u32::from_le_bytes(bytes));
    if words.next() != Some(image::MAGIC) {
        return Err(PolicyError::Magic);
    }
    match words.next() {
        Some(image::VERSION) => {}
        version => return Err(PolicyError::Version(version.unwrap_or(0))),
    }
    let total = words.next().unwrap_or(0) as usize;
    if total < HEADER_WORDS * 4 || !total.is_multiple_of(4) {
        return Err(PolicyError::Length);
    }
    Ok(total)
}

/// The sections that are left, which lie one after the other.
struct Sections<'a> {
    image: &'a [u32],
    table: core::slice::Iter<'a, [u32; 2]>,
    end: usize,
}

impl<'a> Sections<'a> {
    fn new(image: &'a [u32]) -> Result<Self, PolicyError> {
        let table = image.get(SECTION_TABLE_WORD..SECTION_TABLE_WORD + 2 * image::SECTIONS);
        let (table, _) = table.ok_or(PolicyError::Length)?.as_chunks::<2>();
        Ok(Self {
            image,
            table: table.iter(),
            end: HEADER_WORDS,
        })
    }

    /// The next section, which has to be `section`.
    fn next(&mut self, section: Section) -> Result<&'a [u32], PolicyError> {
        let error = PolicyError::Section(section);
        let &[offset, len] = self.table.next().ok_or(error)?;
        let whole_words = offset.is_multiple_of(4) && len.is_multiple_of(4);
        let (start, len) = (offset as usize / 4, len as usize / 4);
        if !whole_words || start < self.end {
            return Err(error);
        }
        self.end = start.checked_add(len).ok_or(error)?;
        self.image.get(start..self.end).ok_or(error)
    }
}

/// Checks one program and its ports against the contract.
fn open_program<'a>(
    kind: ProgramKind,
    record: &'a [u32],
    ops: &'a [[u32; OP_WORDS]],
    contract: &Contract<'a>,
    weights_len: usize,
) -> Result<Program<'a>, PolicyError> {
    let error = |error| PolicyError::Program {
        program: kind,
        error,
    };
    let fault = |fault| error(ProgramError { op: None, fault });
    let words = contract.words_len();
    let steps = contract.context_steps();
    // Words, the first observation, then a pair of tokens per control step.
    let (tokens, past_max) = match kind {
        ProgramKind::Instruct => (words, 0),
        ProgramKind::Start => (1, words),
        ProgramKind::StepDecide | ProgramKind::StepRecord => {
            let earlier = steps.saturating_sub(2).saturating_mul(2);
            (2, words.saturating_add(1).saturating_add(earlier))
        }
        _ => (0, 0),
    };
    let spaces = Spaces {
        weights_len,
        cache_len: contract.cache_len(),
        past_max,
    };
    let program = Program::new_checked(record, ops, spaces).map_err(error)?;
    if program.is_empty() {
        let optional = matches!(kind, ProgramKind::Encode);
        return if optional {
            Ok(program)
        } else {
            Err(PolicyError::Missing(kind))
        };
    }
    if program.tokens() != tokens {
        return Err(fault(Fault::Tokens));
    }
    let ports_fit = program
        .inputs()
        .all(|port| port_fits(&port, inputs_of(kind), contract))
        && program
            .outputs()
            .all(|port| port_fits(&port, outputs_of(kind), contract));
    let gives = outputs_of(kind)
        .first()
        .is_none_or(|&port| program.output(port).is_some());
    if !ports_fit || !gives {
        return Err(fault(Fault::Port));
    }
    Ok(program)
}

/// The port is one of those allowed and has the contract's length.
fn port_fits(record: &PortRecord, allowed: &[Port], contract: &Contract) -> bool {
    let fits = match record.place {
        Place::Span(span) => port_len(record.port, contract) == Some(span.len as usize),
        Place::Int(_) => true,
    };
    fits && allowed.contains(&record.port)
}

/// What a program may read. A compiled program leaves out what does not change its outputs.
fn inputs_of(kind: ProgramKind) -> &'static [Port] {
    match kind {
        ProgramKind::Instruct => &[Port::Words],
        ProgramKind::Start => &[Port::Observation, Port::Timestep],
        ProgramKind::StepDecide | ProgramKind::StepRecord => {
            &[Port::Action, Port::Observation, Port::Timestep]
        }
        ProgramKind::Lookup => &[Port::PlanIndex],
        ProgramKind::Act => &[Port::Observation, Port::Plan, Port::PlanIndex],
        ProgramKind::Encode => &[Port::Observations, Port::Actions],
    }
}

/// What a program may give; it must give the first.
fn outputs_of(kind: ProgramKind) -> &'static [Port] {
    match kind {
        ProgramKind::Instruct | ProgramKind::StepRecord => &[],
        ProgramKind::Start | ProgramKind::StepDecide => &[Port::Logits],
        ProgramKind::Lookup => &[Port::Plan],
        ProgramKind::Act => &[Port::Action],
        ProgramKind::Encode => &[Port::PlanIndex, Port::Latent],
    }
}

/// Elements of a port that is no integer.
fn port_len(port: Port, contract: &Contract) -> Option<usize> {
    match port {
        Port::Observation => Some(contract.observation_len()),
        Port::Action => Some(contract.action_len()),
        Port::Words => contract.words_len().checked_mul(contract.word_dim()),
        Port::Plan | Port::Latent => Some(contract.plan_len()),
        Port::Logits => Some(contract.codebook_len()),
        Port::Observations => contract.horizon().checked_mul(contract.observation_len()),
        Port::Actions => contract.horizon().checked_mul(contract.action_len()),
        Port::Timestep | Port::PlanIndex | Port::InstructionId => None,
    }
}

/// Why an image was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PolicyError {
    /// This processor stores the most significant byte first; images do not.
    BigEndian,
    /// The image does not start on a 4-byte boundary.
    Alignment,
    /// The image ends too early.
    Truncated {
        /// Bytes that there are.
        got: usize,
        /// Bytes that there should be.
        needed: usize,
    },
    /// The first word is another one: this is no program image.
    Magic,
    /// The image has another version.
    Version(u32),
    /// The length in the header makes no sense.
    Length,
    /// A section lies outside the image, out of order, or has the wrong length.
    Section(Section),
    /// The strings are no UTF-8.
    Strings,
    /// The contract makes no sense.
    Contract(ContractError),
    /// The KV cache is larger than what the programs keep in it.
    Cache,
    /// A program that every policy has is missing.
    Missing(ProgramKind),
    /// A program is not well formed.
    Program {
        /// Which one.
        program: ProgramKind,
        /// What is wrong with it.
        error: ProgramError,
    },
}

impl fmt::Display for PolicyError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::BigEndian => {
                f.write_str("program images are little-endian and this processor is not")
            }
            Self::Alignment => f.write_str("the program image does not start on a 4-byte boundary"),
            Self::Truncated { got, needed } => {
                write!(f, "the program image has {got} bytes, {needed} are needed")
            }
            Self::Magic => f.write_str("not a program image"),
            Self::Version(version) => {
                write!(
                    f,
                    "program image of version {version}; this runtime reads version {}",
                    image::VERSION
                )
            }
            Self::Length => f.write_str("the program image states a length that makes no sense"),
            Self::Section(section) => {
                write!(f, "section {section:?} of the program image is malformed")
            }
            Self::Strings => f.write_str("the strings of the program image are no UTF-8"),
            Self::Contract(error) => write!(f, "contract: {error}"),
            Self::Cache => {
                f.write_str("the program image asks for a larger KV cache than its programs use")
            }
            Self::Missing(program) => write!(f, "the program image has no program {program:?}"),
            Self::Program { program, error } => write!(f, "program {program:?}, {error}"),
        }
    }
}

impl Error for PolicyError {}
