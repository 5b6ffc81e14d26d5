//! The program image: how a compiled policy lies in memory, for the compiler that writes it and the core that reads it.
//!
//! An image is little-endian, starts on a 4-byte boundary (64 is better: weight panels then never straddle cache lines) and
//! is a whole number of 4-byte words. It needs no relocation: it may lie in flash, in a mapped file or in a `static`.
//!
//! ```text
//! word 0   MAGIC
//!      1   VERSION
//!      2   total length in bytes
//!      3   CRC-32 of the whole image, taken with this word zero
//!      4.. zero
//!      8.. six pairs (offset, length) in bytes, one per section, in the order of `Section`
//!     20.. zero up to word 32
//! Contract   ContractRecord, then `observation_len + action_len` ElementRecords (observation first), then
//!            `instruction_count` InstructionRecords
//! Strings    UTF-8, zero-padded to a word; `Text` points into it
//! Programs   seven ProgramRecords, in the order of `ProgramKind`
//! Ops        `OP_WORDS` words per op, the programs' ops one after the other
//! Weights    starts on a 64-byte boundary. Packed panels, in the format that their ops say; f32 biases, tables, words of the
//!            known instructions
//! Golden     empty, or: GoldenRecord, observations f32 [T, O], plan indices u32 [T], actions f32 [T, A]
//! ```
//!
//! Every section starts on a word; sections do not overlap and follow each other in this order. [`Layout`] computes the
//! offsets, [`Layout::header`] the header and [`crc32`] the checksum, so a writer only fills records
//! ([`Field::put`] into [`Field::WORDS`] words each).

use crate::codec::{Field, Reader, Writer, record, word_enum};
use crate::op::{Place, Port, Span, WeightSpan};

/// First word of an image: `LADS` in ASCII.
pub const MAGIC: u32 = u32::from_le_bytes(*b"LADS");

/// Version of the format that this module describes.
pub const VERSION: u32 = 4;

/// Words of the header.
pub const HEADER_WORDS: usize = 32;

/// Header word of the checksum.
pub const CRC_WORD: usize = 3;

/// Header word of the first section's offset.
pub const SECTION_TABLE_WORD: usize = 8;

/// How many sections an image has.
pub const SECTIONS: usize = 6;

/// How many programs an image has room for.
pub const PROGRAMS: usize = 7;

/// How many inputs, and how many outputs, a program may have.
pub const PORTS: usize = 8;

/// Alignment of the weights inside the image, in bytes.
pub const WEIGHTS_ALIGN: usize = 64;

word_enum! {
    /// The parts of an image, in their order.
    pub enum Section {
        /// What the policy expects and promises.
        Contract = 0,
        /// All texts.
        Strings = 1,
        /// One record per program.
        Programs = 2,
        /// The programs' ops.
        Ops = 3,
        /// Everything constant.
        Weights = 4,
        /// The recorded episode of the self-test.
        Golden = 5,
    }
}

word_enum! {
    /// The programs of a policy of kind `lads`, in the order of their records.
    pub enum ProgramKind {
        /// `Words` → the KV cache's first `context.words` rows; runs at `P = 0`, only the instruction's own rows are kept.
        Instruct = 0,
        /// `Observation`, `Timestep` → `Logits`; appends 1 token. The first control step of a context.
        Start = 1,
        /// `Action` (previous), `Observation`, `Timestep` → `Logits`; appends 2 tokens. Steps that decide.
        StepDecide = 2,
        /// The same inputs, no output; appends 2 tokens. All other steps.
        StepRecord = 3,
        /// `PlanIndex` → `Plan`.
        Lookup = 4,
        /// `Observation` and `Plan`, `PlanIndex` or both → `Action`.
        Act = 5,
        /// `Observations`, `Actions` → `PlanIndex`, and `Latent` if kept. May be absent (no ops).
        Encode = 6,
    }
}

record! {
    /// A text: `len` bytes from `offset` in the string section.
    #[derive(Eq, Default)]
    pub struct Text {
        /// First byte.
        pub offset: u32,
        /// Bytes.
        pub len: u32,
    }
}

word_enum! {
    /// What kind of policy an image holds.
    pub enum PolicyKind {
        /// Learned alignment of discrete skills: the words of an instruction, a codebook of plans, a low-level policy.
        Lads = 1,
    }
}

word_enum! {
    /// How the next plan is picked from the logits.
    pub enum DecisionRule {
        /// The largest logit, the first of equal ones.
        Argmax = 0,
        /// At random with the softmax of the logits over the temperature.
        Sample = 1,
    }
}

word_enum! {
    /// What happens when a context has seen as many control steps as the policy was trained on.
    pub enum Beyond {
        /// The words stay in the context, the timestep starts again at 0.
        Restart = 0,
        /// The step is refused.
        Refuse = 1,
    }
}

word_enum! {
    /// Order of the components of the quaternions in an observation.
    pub enum QuaternionOrder {
        /// There are none.
        None = 0,
        /// Scalar first.
        Wxyz = 1,
        /// Scalar last.
        Xyzw = 2,
    }
}

record! {
    /// The contract's fixed part.
    pub struct ContractRecord {
        /// What the programs mean.
        pub kind: PolicyKind,
        /// Environment, for example `franka-kitchen`.
        pub environment_id: Text,
        /// The environment's version.
        pub environment_version: Text,
        /// Time from one control step to the next, in seconds.
        pub control_period_s: f32,
        /// Control steps from one decision to the next, `H`.
        pub horizon: u32,
        /// Codebook entries, `M`.
        pub codebook_len: u32,
        /// Elements of a plan, `D`.
        pub plan_len: u32,
        /// How the plan is picked, unless the caller says otherwise.
        pub rule: DecisionRule,
        /// Divides the logits when sampling.
        pub temperature: f32,
        /// Seed of the sampling.
        pub seed: u64,
        /// Elements of an observation, `O`.
        pub observation_len: u32,
        /// Elements of an action, `A`.
        pub action_len: u32,
        /// Order of the quaternions.
        pub quaternion_order: QuaternionOrder,
        /// Words of the longest instruction, `L`.
        pub words_len: u32,
        /// Elements of a word embedding, `E`.
        pub word_dim: u32,
        /// Control steps that a context holds.
        pub context_steps: u32,
        /// What happens then.
        pub beyond: Beyond,
        /// Transformer layers.
        pub layers: u32,
        /// Attention heads.
        pub heads: u32,
        /// Elements per head.
        pub head_dim: u32,
        /// Instructions in the table.
        pub instruction_count: u32,
        /// Language encoder that made the word embeddings.
        pub encoder: Text,
        /// SHA-256 of its weights, hexadecimal.
        pub encoder_sha256: Text,
        /// SHA-256 of the bundle that was compiled, hexadecimal.
        pub bundle_sha256: Text,
        /// Elements of state that the programs use: the end of the last cache span.
        pub cache_len: u32,
    }
}

record! {
    /// One element of the observation or the action.
    pub struct ElementRecord {
        /// Name.
        pub name: Text,
        /// Unit, `1` for none.
        pub unit: Text,
        /// Joint it belongs to; empty for none.
        pub joint: Text,
        /// Smallest value in the contract.
        pub min: f32,
        /// Largest value in the contract.
        pub max: f32,
    }
}

record! {
    /// One known instruction.
    pub struct InstructionRecord {
        /// Short name.
        pub id: Text,
        /// What the person says.
        pub text: Text,
        /// Sub-tasks, separated by commas.
        pub sub_tasks: Text,
        /// Name of the set that it belongs to in evaluations, such as `seen`.
        pub split: Text,
        /// Words, `1..=L`.
        pub words_len: u32,
        /// `[words_len, E]` word embeddings.
        pub words: WeightSpan,
    }
}

/// A port and where it lives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PortRecord {
    /// Which value.
    pub port: Port,
    /// Where it lives.
    pub place: Place,
}

impl Default for PortRecord {
    /// What fills the unused entries of a [`ProgramRecord`]: all words zero.
    fn default() -> Self {
        Self {
            port: Port::Observation,
            place: Place::Span(Span::default()),
        }
    }
}

impl Field for PortRecord {
    const WORDS: usize = Port::WORDS + Place::WORDS;
    fn put(&self, out: &mut Writer) {
        self.port.put(out);
        self.place.put(out);
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        Some(Self {
            port: Port::take(from)?,
            place: Place::take(from)?,
        })
    }
}

record! {
    /// One program.
    pub struct ProgramRecord {
        /// Index of its first op in the op section.
        pub first_op: u32,
        /// Number of ops; 0 when the image has no such program.
        pub ops_len: u32,
        /// Elements of arena that it needs.
        pub arena_len: u32,
        /// Tokens that a run appends to the KV cache.
        pub tokens: u32,
        /// How many of `inputs` are used.
        pub inputs_len: u32,
        /// Set by the caller before a run. Ops may overwrite them once they are read.
        pub inputs: [PortRecord; PORTS],
        /// How many of `outputs` are used.
        pub outputs_len: u32,
        /// Valid after a run.
        pub outputs: [PortRecord; PORTS],
    }
}

record! {
    /// Start of a golden section that is not empty.
    pub struct GoldenRecord {
        /// Which instruction was followed.
        pub instruction: u32,
        /// Control steps, `T`.
        pub steps: u32,
        /// Largest absolute difference of an action that the self-test accepts.
        pub tolerance: f32,
    }
}

/// Where a section lies: `offset` and `len` in bytes, both whole words.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SectionSpan {
    /// First byte.
    pub offset: usize,
    /// Bytes.
    pub len: usize,
}

/// Where the sections of an image lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    sections: [SectionSpan; SECTIONS],
    total_bytes: usize,
}

impl Layout {
    /// Lays sections of these lengths, in bytes and whole words, one after the other. `None` when a length is no whole number
    /// of words or the image would not fit 32-bit offsets.
    pub fn new(lens: [usize; SECTIONS]) -> Option<Self> {
        let mut sections = [SectionSpan::default(); SECTIONS];
        let mut end = HEADER_WORDS * 4;
        for ((span, len), kind) in sections.iter_mut().zip(lens).zip(Section::ALL) {
            let align = if matches!(kind, Section::Weights) {
                WEIGHTS_ALIGN
            } else {
                4
            };
            let offset = end.checked_next_multiple_of(align)?;
            end = offset.checked_add(len)?;
            if len % 4 != 0 {
                return None;
            }
            *span = SectionSpan { offset, len };
        }
        u32::try_from(end).ok()?;
        Some(Self {
            sections,
            total_bytes: end,
        })
    }

    /// Where a section lies.
    pub fn section(&self, section: Section) -> SectionSpan {
        self.sections
            .get(section as usize)
            .copied()
            .unwrap_or_default()
    }

    /// Bytes of the image.
    pub fn total_bytes(&self) -> usize {
        self.total_bytes
    }

    /// The header, its checksum still zero: write [`crc32`] of the whole image to word [`CRC_WORD`] last.
    pub fn header(&self) -> [u32; HEADER_WORDS] {
        let mut words = [0; HEADER_WORDS];
        let mut out = Writer::new(&mut words);
        for word in [MAGIC, VERSION, self.total_bytes as u32, 0, 0, 0, 0, 0] {
            out.word(word);
        }
        for span in self.sections {
            out.word(span.offset as u32);
            out.word(span.len as u32);
        }
        words
    }
}

/// What each value of a byte does to the checksum: the reflected polynomial, bit by bit.
const CRC_TABLE: [u32; 256] = {
    let mut table = [0; 256];
    let mut rest: &mut [u32] = &mut table;
    let mut value = 0;
    while let Some((entry, more)) = rest.split_first_mut() {
        let mut crc: u32 = value;
        let mut bit = 0_u32;
        while bit < 8 {
            crc = (crc >> 1) ^ (0xedb8_8320 & (crc & 1).wrapping_neg());
            bit = bit.wrapping_add(1);
        }
        *entry = crc;
        rest = more;
        value = value.wrapping_add(1);
    }
    table
};

/// CRC-32 (IEEE 802.3, the one of zip and PNG) of an image, its checksum word taken as zero.
pub fn crc32(image: &[u8]) -> u32 {
    let byte_in = |crc: u32, byte: u8| {
        let index = (crc ^ u32::from(byte)) & 0xff;
        (crc >> 8) ^ CRC_TABLE.get(index as usize).copied().unwrap_or(0)
    };
    let (words, rest) = image.as_chunks::<4>();
    let mut crc = u32::MAX;
    for (i, word) in words.iter().enumerate() {
        let word = if i == CRC_WORD { [0; 4] } else { *word };
        crc = word.into_iter().fold(crc, byte_in);
    }
    crc = rest.iter().copied().fold(crc, byte_in);
    !crc
}
