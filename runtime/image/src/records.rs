//! Records of an image: the policy's contract, programs, states and schedule.
//!
//! ```text
//! channel   a value at the policy's edge: an observation, the action, an instruction, noise, a demonstration
//! state     memory that survives a call: taken over as a whole (plain), the last rows (ring), rows appended (KV cache)
//! entry     a compiled program with named ports, each bound to a channel, a state or an integer
//! call      one line of the schedule: at which event and when an entry runs, how often, what it selects and clears
//! ```
//!
//! A record is the words of its fields in the order of declaration. The fields state what lengths
//! and indices have to satisfy; the core checks it once when an image is opened, and trusts nothing
//! before.

use crate::codec::{Field, Reader, Writer, record, word_enum};
use crate::place::{Place, WeightSpan};

/// Largest number of states with rows (rings and KV caches) that an image may have; they come first
/// among the states.
pub const MAX_ROW_STATES: usize = 8;

/// Index that stands for none, such as the instruction of a policy without instructions.
pub const NONE: u32 = u32::MAX;

record! {
    /// Text of `len` bytes from `offset` in the string section.
    #[derive(Eq, Default)]
    pub struct Text {
        /// Offset of the first byte.
        pub offset: u32,
        /// Number of bytes.
        pub len: u32,
    }
}

word_enum! {
    /// Rule by which an index is picked from the scores that a call selects from.
    pub enum SelectionRule {
        /// The index with the largest score, the first of equal ones.
        Argmax = 0,
        /// An index drawn at random with the softmax of the scores over the temperature.
        Sample = 1,
    }
}

word_enum! {
    /// Source of the values of noise channels.
    pub enum NoiseRule {
        /// Zeros, the mean of the standard normal distribution.
        Zero = 0,
        /// Standard normal numbers of a seeded generator.
        Seeded = 1,
    }
}

word_enum! {
    /// Behaviour once a context has seen as many control steps as the policy was trained on.
    pub enum Beyond {
        /// Clear the states of the episode, keep the instruction, restart the timestep at 0.
        Restart = 0,
        /// Refuse the step.
        Refuse = 1,
    }
}

word_enum! {
    /// Order of the components of the quaternions in a channel.
    pub enum QuaternionOrder {
        /// The channel has no quaternions.
        None = 0,
        /// Quaternions with the scalar first.
        Wxyz = 1,
        /// Quaternions with the scalar last.
        Xyzw = 2,
    }
}

record! {
    /// Fixed part of the contract.
    pub struct ContractRecord {
        /// Name of the family that the bundle belongs to, such as `lads`; informational, nothing
        /// depends on it.
        pub family: Text,
        /// Name of the environment, for example `franka-kitchen`.
        pub environment_id: Text,
        /// Version of the environment.
        pub environment_version: Text,
        /// Control period, the time from one control step to the next, in seconds.
        pub control_period_s: f32,
        /// Rule that picks an index unless the caller sets another one.
        pub selection: SelectionRule,
        /// Divisor of the scores when sampling.
        pub temperature: f32,
        /// Seed of the sampling.
        pub selection_seed: u64,
        /// Source of noise unless the caller sets another one.
        pub noise: NoiseRule,
        /// Seed of the noise.
        pub noise_seed: u64,
        /// Number of control steps that a context holds; 0 if it is unbounded.
        pub context_steps: u32,
        /// Behaviour after `context_steps` control steps.
        pub beyond: Beyond,
        /// Language encoder that made the word embeddings; empty without instructions.
        pub encoder: Text,
        /// SHA-256 of the language encoder's weights, hexadecimal.
        pub encoder_sha256: Text,
        /// Smallest similarity to a known instruction at which another sentence is followed; above
        /// 1 if none is.
        pub acceptance: f32,
        /// SHA-256 of the bundle that was compiled, hexadecimal.
        pub bundle_sha256: Text,
        /// Largest number of multiply-adds of a control step, and of the calls of any other event.
        pub worst_work: u64,
    }
}

word_enum! {
    /// Purpose of a channel.
    pub enum Role {
        /// Given by the caller in every control step.
        Observation = 0,
        /// Written by every control step; as an input of an entry, the action executed last.
        Action = 1,
        /// Word embeddings, `[words, elements]`, zero-padded to the longest instruction.
        Instruction = 2,
        /// Random numbers: each run of an entry that reads the channel draws new ones.
        Noise = 3,
        /// A piece of a demonstration, given by the caller to be encoded.
        Demonstration = 4,
    }
}

word_enum! {
    /// Type of a channel's elements.
    pub enum DType {
        /// Elements of 32-bit floats.
        F32 = 0,
        /// Elements of bytes, such as the pixels of a camera.
        U8 = 1,
        /// Elements of signed 32-bit integers.
        I32 = 2,
    }
}

record! {
    /// Record of one channel.
    pub struct ChannelRecord {
        /// Name of the channel, unique in the image.
        pub name: Text,
        /// Purpose of the channel.
        pub role: Role,
        /// Type of the channel's elements.
        pub dtype: DType,
        /// Number of `dims` in use, `1..=4`.
        pub rank: u32,
        /// Lengths of the axes; ones past the rank.
        pub dims: [u32; 4],
        /// Order of the components of the channel's quaternions.
        pub quaternions: QuaternionOrder,
        /// Description of the reference that the values are relative to; empty for none.
        pub reference: Text,
        /// Index of the channel's first record in the element section.
        pub first_element: u32,
        /// Number of the channel's element records: one for each element, or none: then `min` and
        /// `max` are the limits of all elements.
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
        /// Name of the element.
        pub name: Text,
        /// Unit of the element; `1` for a dimensionless one.
        pub unit: Text,
        /// Joint that the element belongs to; empty for none.
        pub joint: Text,
        /// Quantity of the joint: position, velocity, effort; empty where the bundle does not say.
        pub interface: Text,
        /// Unit of the physical value that the element stands for; empty where the bundle does not
        /// say.
        pub physical_unit: Text,
        /// Physical value of one unit of the element: physical = reference + offset + scale * value.
        pub scale: f32,
        /// Physical value for an element of zero, without the channel's reference.
        pub offset: f32,
        /// Smallest value that the contract allows.
        pub min: f32,
        /// Largest value that the contract allows.
        pub max: f32,
    }
}

record! {
    /// One known instruction.
    pub struct InstructionRecord {
        /// Short name of the instruction.
        pub id: Text,
        /// The instruction as a person says it.
        pub text: Text,
        /// Number of words, from 1 to the first dimension of the instruction channel.
        pub words_len: u32,
        /// Word embeddings `[words_len, E]`.
        pub words: WeightSpan,
    }
}

word_enum! {
    /// Way in which a state is stored.
    pub enum StateKind {
        /// Values replaced as a whole at the end of a control step.
        Plain = 0,
        /// Ring of the last rows that were appended.
        Ring = 1,
        /// Rows appended after the valid ones: the keys and values of attention.
        Kv = 2,
    }
}

word_enum! {
    /// Lifetime of a state.
    pub enum Scope {
        /// The state lasts until another instruction is set.
        Instruction = 0,
        /// The state lasts until the episode ends or the context starts again; rows that the
        /// instruct event appended stay.
        Episode = 1,
        /// The state lasts until the control step ends.
        Step = 2,
    }
}

word_enum! {
    /// Content of the rows that a ring does not have yet, when it is read as a whole.
    pub enum Fill {
        /// Rows of zeros.
        Zero = 0,
        /// Copies of the oldest row.
        First = 1,
    }
}

record! {
    /// One state of the policy. Rings and KV caches come first, [`MAX_ROW_STATES`] at most.
    pub struct StateRecord {
        /// Name of the state, unique in the image.
        pub name: Text,
        /// Way in which the state is stored.
        pub kind: StateKind,
        /// Lifetime of the state; KV caches last an episode.
        pub scope: Scope,
        /// Number of elements of a plain state or of a ring's row; number of words of a whole KV
        /// cache.
        pub width: u32,
        /// Number of rows of a ring or of a KV cache; 1 for a plain state.
        pub rows: u32,
        /// Content of a ring's missing rows; `Zero` for other states.
        pub fill: Fill,
        /// Offset of the state, one state after the other: rings and KV caches in words of the row
        /// memory, plain states in elements of a bank, those of a step in elements of scratch.
        pub offset: u32,
    }
}

word_enum! {
    /// Kind of thing that a port is bound to.
    pub enum SourceKind {
        /// A channel, by its index.
        Channel = 0,
        /// A state, by its index: a plain state, or a ring: all its rows as an input, its newest row as an output.
        State = 1,
        /// Row `pass` of a ring, the oldest first; an input.
        Row = 2,
        /// Number of control steps since the context began; an integer.
        Timestep = 3,
        /// Phase, the timestep modulo the parameter; an integer.
        Phase = 4,
        /// Number of earlier runs of the same call; an integer.
        Pass = 5,
        /// Selected index in force; an integer.
        Selected = 6,
    }
}

/// Binding of a port, with the index or number that belongs to it (zero where none does).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Source {
    /// Kind of thing that the port is bound to.
    pub kind: SourceKind,
    /// Index of the channel or state, or the period of a phase.
    pub of: u32,
}

impl Source {
    /// Returns true for an integer, which lives in a slot.
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
        /// Name of the port, unique among an entry's inputs or outputs.
        pub name: Text,
        /// Binding of the port.
        pub source: Source,
        /// Place of the port's value while the entry runs.
        pub place: Place,
    }
}

record! {
    /// Record of one entry.
    pub struct EntryRecord {
        /// Name of the entry, such as `low_level/act`, unique in the image.
        pub name: Text,
        /// Index of the entry's first op in the op section.
        pub first_op: u32,
        /// Number of ops.
        pub ops_len: u32,
        /// Number of elements of arena that the entry needs.
        pub arena_len: u32,
        /// Index of the KV cache that the entry's attentions read and append to; [`NONE`] for none.
        pub cache: u32,
        /// Number of rows that a run appends to the KV cache.
        pub tokens: u32,
        /// Index of the entry's first input in the port section.
        pub first_input: u32,
        /// Number of inputs, whose values are set before a run. Ops may overwrite inputs once they
        /// are read.
        pub inputs_len: u32,
        /// Index of the entry's first output in the port section.
        pub first_output: u32,
        /// Number of outputs, whose values are valid after a run.
        pub outputs_len: u32,
    }
}

word_enum! {
    /// Event that makes a call run.
    pub enum Event {
        /// An instruction is set.
        Instruct = 0,
        /// A control step.
        Step = 1,
        /// An action is requested for an index that the caller chose.
        Follow = 2,
        /// A demonstration is to be encoded.
        Encode = 3,
    }
}

word_enum! {
    /// Control steps of a context at which a call runs.
    pub enum When {
        /// Every control step.
        Always = 0,
        /// The control step at timestep 0.
        First = 1,
        /// Control steps at multiples of the period, 0 among them.
        Every = 2,
    }
}

word_enum! {
    /// Number of times that a call runs its entry.
    pub enum Repeat {
        /// A fixed number of times, `count`.
        Times = 0,
        /// One run for each valid row of the ring with index `count`.
        Rows = 1,
    }
}

record! {
    /// One line of the schedule. The calls of an event run in the order of their records.
    pub struct CallRecord {
        /// Event that makes the call run.
        pub event: Event,
        /// Control steps at which the call runs; `Always` for events other than a step.
        pub when: When,
        /// Period of `Every`, above 0; 0 for the others.
        pub every: u32,
        /// True if the call runs only if no call of its chain has run before it: a chain is a call
        /// and all following calls with this flag.
        pub otherwise: bool,
        /// Index of the entry to run.
        pub entry: u32,
        /// Rule for the number of runs.
        pub repeat: Repeat,
        /// Number of runs, or index of the ring.
        pub count: u32,
        /// Index of the plain state whose elements are the scores of the selection after the runs;
        /// [`NONE`] for no selection.
        pub select: u32,
        /// Position, in the section of clears, of the first state that is cleared before the runs.
        pub first_clear: u32,
        /// Number of states that are cleared.
        pub clears_len: u32,
    }
}

record! {
    /// Start of a golden section that is not empty. After it follow, each in whole words: for every
    /// observation channel in their order `[T, elements]` values; with `selects` the indices in
    /// force `u32 [T]`; noise `f32 [T, noise_len]`; actions `f32 [T, A]`.
    pub struct GoldenRecord {
        /// Number of the instruction that was followed; [`NONE`] without instructions.
        pub instruction: u32,
        /// Number of control steps, `T`.
        pub steps: u32,
        /// True if an index is in force.
        pub selects: bool,
        /// Number of draws of noise of a step, in the order in which they are used, padded with
        /// zeros.
        pub noise_len: u32,
        /// Largest absolute difference of an action that the self-test accepts.
        pub tolerance: f32,
    }
}
