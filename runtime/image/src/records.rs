//! The records of an image: what a policy expects and promises, and how it is put together.
//!
//! ```text
//! channel   a value at the policy's edge: an observation, the action, an instruction, noise, a demonstration
//! state     memory that survives a call: taken over as a whole (plain), the last rows (ring), rows appended (KV cache)
//! entry     a compiled program with named ports, each bound to a channel, a state or an integer
//! call      one line of the schedule: at which event and when an entry runs, how often, what it selects and clears
//! ```
//!
//! A record is the words of its fields in the order of declaration. What lengths and indices have to satisfy is said at the
//! fields and checked once by the core when an image is opened; nothing here is trusted.

use crate::codec::{Field, Reader, Writer, record, word_enum};
use crate::place::{Place, WeightSpan};

/// The most states with rows (rings and KV caches) that an image may have; they come first among the states.
pub const MAX_ROW_STATES: usize = 8;

/// The index that means none, such as the instruction of a policy without instructions.
pub const NONE: u32 = u32::MAX;

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
    /// How an index is picked from the scores that a call selects from.
    pub enum SelectionRule {
        /// The largest score, the first of equal ones.
        Argmax = 0,
        /// At random with the softmax of the scores over the temperature.
        Sample = 1,
    }
}

word_enum! {
    /// Where the values of noise channels come from.
    pub enum NoiseRule {
        /// Zeros: the mean of what is drawn.
        Zero = 0,
        /// Standard normals of a seeded generator.
        Seeded = 1,
    }
}

word_enum! {
    /// What happens when a context has seen as many control steps as the policy was trained on.
    pub enum Beyond {
        /// States of the episode are cleared, the instruction stays, the timestep starts again at 0.
        Restart = 0,
        /// The step is refused.
        Refuse = 1,
    }
}

word_enum! {
    /// Order of the components of the quaternions in a channel.
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
        /// Name of the family that the bundle belongs to, such as `lads`: to be shown, nothing depends on it.
        pub family: Text,
        /// Environment, for example `franka-kitchen`.
        pub environment_id: Text,
        /// The environment's version.
        pub environment_version: Text,
        /// Time from one control step to the next, in seconds.
        pub control_period_s: f32,
        /// How an index is picked, unless the caller says otherwise.
        pub selection: SelectionRule,
        /// Divides the scores when sampling.
        pub temperature: f32,
        /// Seed of the sampling.
        pub selection_seed: u64,
        /// Where noise comes from, unless the caller says otherwise.
        pub noise: NoiseRule,
        /// Seed of the noise.
        pub noise_seed: u64,
        /// Control steps that a context holds; 0 when there is no such bound.
        pub context_steps: u32,
        /// What happens then.
        pub beyond: Beyond,
        /// Language encoder that made the word embeddings; empty without instructions.
        pub encoder: Text,
        /// SHA-256 of its weights, hexadecimal.
        pub encoder_sha256: Text,
        /// Similarity to a known instruction from which other sentences are followed; above 1 when none are.
        pub acceptance: f32,
        /// SHA-256 of the bundle that was compiled, hexadecimal.
        pub bundle_sha256: Text,
        /// Most multiply-adds of a control step, and of the calls of any other event.
        pub worst_work: u64,
    }
}

word_enum! {
    /// What a channel is for.
    pub enum Role {
        /// Given by the caller in every control step.
        Observation = 0,
        /// Written by every control step; as an input of an entry, what was last executed.
        Action = 1,
        /// Word embeddings, `[words, elements]`, zero-padded to the longest instruction.
        Instruction = 2,
        /// Random numbers: each run of an entry that reads the channel draws anew.
        Noise = 3,
        /// A piece of a demonstration, given by the caller to be encoded.
        Demonstration = 4,
    }
}

word_enum! {
    /// The type of a channel's elements.
    pub enum DType {
        /// 32-bit floats.
        F32 = 0,
        /// Bytes, such as the pixels of a camera.
        U8 = 1,
        /// Signed 32-bit integers.
        I32 = 2,
    }
}

record! {
    /// One channel.
    pub struct ChannelRecord {
        /// Name, no two alike.
        pub name: Text,
        /// What it is for.
        pub role: Role,
        /// Type of its elements.
        pub dtype: DType,
        /// How many of `dims` count, `1..=4`.
        pub rank: u32,
        /// Shape; ones behind the rank.
        pub dims: [u32; 4],
        /// Order of quaternions.
        pub quaternions: QuaternionOrder,
        /// What the values are relative to, in words; empty for nothing.
        pub reference: Text,
        /// First of its records in the element section.
        pub first_element: u32,
        /// As many as the channel has elements, or none: then `min` and `max` are the limits of all of them.
        pub elements_len: u32,
        /// Smallest value of any element.
        pub min: f32,
        /// Largest value of any element.
        pub max: f32,
    }
}

record! {
    /// One element of a channel.
    pub struct ElementRecord {
        /// Name.
        pub name: Text,
        /// Unit, `1` for none.
        pub unit: Text,
        /// Joint that it belongs to; empty for none.
        pub joint: Text,
        /// What of the joint: position, velocity, effort; empty where nobody said.
        pub interface: Text,
        /// Unit of the physical value that the element stands for; empty where nobody said.
        pub physical_unit: Text,
        /// Physical value of one unit of the element: physical = reference + offset + scale * value.
        pub scale: f32,
        /// Physical value of zero, on top of the channel's reference.
        pub offset: f32,
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
        /// Words, from 1 to the first dimension of the instruction channel.
        pub words_len: u32,
        /// `[words_len, E]` word embeddings.
        pub words: WeightSpan,
    }
}

word_enum! {
    /// How a state is kept.
    pub enum StateKind {
        /// As a whole, taken over at the end of a control step.
        Plain = 0,
        /// The last rows that were appended.
        Ring = 1,
        /// Rows appended behind the valid ones: the keys and values of attention.
        Kv = 2,
    }
}

word_enum! {
    /// How long a state lasts.
    pub enum Scope {
        /// Until another instruction is set.
        Instruction = 0,
        /// Until the episode ends or the context starts again; what the instruct event appended stays.
        Episode = 1,
        /// Until the control step ends.
        Step = 2,
    }
}

word_enum! {
    /// What stands in the rows that a ring does not have yet, where it is read as a whole.
    pub enum Fill {
        /// Zeros.
        Zero = 0,
        /// The oldest row.
        First = 1,
    }
}

record! {
    /// One state. Rings and KV caches come first, [`MAX_ROW_STATES`] at most.
    pub struct StateRecord {
        /// Name, no two alike.
        pub name: Text,
        /// How it is kept.
        pub kind: StateKind,
        /// How long it lasts; KV caches last an episode.
        pub scope: Scope,
        /// Elements of a plain state or of a ring's row; words of a whole KV cache.
        pub width: u32,
        /// Rows of a ring or of a KV cache; 1 for a plain state.
        pub rows: u32,
        /// What a ring's missing rows are; `Zero` for others.
        pub fill: Fill,
        /// Where it lies, one state behind the other: rings and KV caches in words of the row memory, plain states in elements of
        /// a bank, those of a step in elements of scratch.
        pub offset: u32,
    }
}

word_enum! {
    /// What a port is bound to.
    pub enum SourceKind {
        /// A channel, by its index.
        Channel = 0,
        /// A state, by its index: a plain state, or a ring: all its rows as an input, its newest row as an output.
        State = 1,
        /// As an input: row `pass` of a ring, the oldest first.
        Row = 2,
        /// As an integer: control steps since the context began.
        Timestep = 3,
        /// As an integer: the timestep modulo the parameter.
        Phase = 4,
        /// As an integer: how many runs of the same call came before.
        Pass = 5,
        /// As an integer: the index in force.
        Selected = 6,
    }
}

/// What a port is bound to, with the index or number that belongs to it (zero where none does).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Source {
    /// What it is.
    pub kind: SourceKind,
    /// Index of the channel or state, or the period of a phase.
    pub of: u32,
}

impl Source {
    /// True for an integer, which lives in a slot.
    pub const fn is_int(self) -> bool {
        matches!(
            self.kind,
            SourceKind::Timestep | SourceKind::Phase | SourceKind::Pass | SourceKind::Selected
        )
    }
}

impl Field for Source {
    const WORDS: usize = 2;
    fn put(&self, out: &mut Writer) {
        self.kind.put(out);
        self.of.put(out);
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        Some(Self {
            kind: SourceKind::take(from)?,
            of: u32::take(from)?,
        })
    }
}

record! {
    /// One port of an entry.
    pub struct PortRecord {
        /// Name, no two alike among an entry's inputs or outputs.
        pub name: Text,
        /// What it is bound to.
        pub source: Source,
        /// Where it lives while the entry runs.
        pub place: Place,
    }
}

record! {
    /// One entry.
    pub struct EntryRecord {
        /// Name, such as `low_level/act`; no two alike.
        pub name: Text,
        /// Index of its first op in the op section.
        pub first_op: u32,
        /// Number of ops.
        pub ops_len: u32,
        /// Elements of arena that it needs.
        pub arena_len: u32,
        /// The KV cache that its attentions read and append to; [`NONE`] for none.
        pub cache: u32,
        /// Rows that a run appends to the KV cache.
        pub tokens: u32,
        /// First of its inputs in the port section.
        pub first_input: u32,
        /// Values that are set before a run. Ops may overwrite them once they are read.
        pub inputs_len: u32,
        /// First of its outputs in the port section.
        pub first_output: u32,
        /// Values that are valid after a run.
        pub outputs_len: u32,
    }
}

word_enum! {
    /// What makes a call run.
    pub enum Event {
        /// An instruction is set.
        Instruct = 0,
        /// A control step.
        Step = 1,
        /// An action is asked for with an index that the caller chose.
        Follow = 2,
        /// A demonstration is to be encoded.
        Encode = 3,
    }
}

word_enum! {
    /// At which control steps of a context a call runs.
    pub enum When {
        /// At all.
        Always = 0,
        /// At timestep 0.
        First = 1,
        /// At multiples of the period, 0 among them.
        Every = 2,
    }
}

word_enum! {
    /// How often a call runs its entry.
    pub enum Repeat {
        /// As often as the number says.
        Times = 0,
        /// Once per valid row of the ring of this index.
        Rows = 1,
    }
}

record! {
    /// One line of the schedule. The calls of an event run in the order of their records.
    pub struct CallRecord {
        /// What makes it run.
        pub event: Event,
        /// At which steps; `Always` for events other than a step.
        pub when: When,
        /// Period of `Every`, above 0; 0 for the others.
        pub every: u32,
        /// Whether it runs only if no call of its chain has run before it: a chain is a call and all such calls that follow it.
        pub otherwise: bool,
        /// The entry.
        pub entry: u32,
        /// How often it runs.
        pub repeat: Repeat,
        /// Number of runs, or index of the ring.
        pub count: u32,
        /// The plain state whose elements are the scores of what is selected after the runs; [`NONE`] for none.
        pub select: u32,
        /// First of the states that are cleared before the runs, in the section of clears.
        pub first_clear: u32,
        /// How many are cleared.
        pub clears_len: u32,
    }
}

record! {
    /// Start of a golden section that is not empty. Behind it, each in whole words: for every observation channel in their order
    /// `[T, elements]` values; with `selects` the indices in force `u32 [T]`; noise `f32 [T, noise_len]`; actions `f32 [T, A]`.
    pub struct GoldenRecord {
        /// Which instruction was followed; [`NONE`] without instructions.
        pub instruction: u32,
        /// Control steps, `T`.
        pub steps: u32,
        /// Whether an index is in force.
        pub selects: bool,
        /// All draws of a step in the order in which they are used, zeros behind.
        pub noise_len: u32,
        /// Largest absolute difference of an action that the self-test accepts.
        pub tolerance: f32,
    }
}
