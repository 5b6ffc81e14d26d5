//! Descriptions of a policy: contract, channels, elements and instructions.

use core::ffi::c_char;
use core::slice;

use lads_core::{
    Beyond, Channel, DType, Decision, Element, Interval, KnownInstruction, Noise, Policy,
    QuaternionOrder, Role,
};

use super::{LADS_NOISE_SEEDED, LADS_NOISE_ZERO, LADS_NONE};
use crate::versioned::versioned;

/// Number of 64-bit words of a `lads_policy`.
pub const LADS_POLICY_WORDS: usize = 96;

/// An open policy: a checked view on a program image, in memory of the caller. Its content is private; it may not be moved or
/// copied after it was opened, and the image has to stay where it is, unchanged, as long as the policy is used.
#[repr(C)]
pub struct LadsPolicy {
    /// Private content of the policy.
    pub private_words: [u64; LADS_POLICY_WORDS],
}

/// A controller with its guard, at the start of its workspace; its content is private. Private.
pub struct LadsController {
    _private: [u8; 0],
}

/// Text in UTF-8, without a zero at the end: print it with "%.*s", (int)text.len, text.data.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsText {
    /// Pointer to the first character; never null after a call wrote it.
    pub data: *const c_char,
    /// Number of bytes.
    pub len: usize,
}

impl LadsText {
    pub(crate) fn new(text: &str) -> Self {
        Self {
            data: text.as_ptr().cast(),
            len: text.len(),
        }
    }

    /// Returns the text, which lives as long as the memory that it points into.
    ///
    /// # Safety
    /// The data are those of a text that lives during `'a`.
    pub unsafe fn as_str<'a>(self) -> &'a str {
        // SAFETY: the caller guarantees it.
        let bytes = unsafe { slice::from_raw_parts(self.data.cast(), self.len) };
        str::from_utf8(bytes).unwrap_or_default()
    }
}

impl Default for LadsText {
    fn default() -> Self {
        Self::new("")
    }
}

/// Behaviour at a full context: it restarts after the instruction, at timestep 0, and the policy
/// continues.
pub const LADS_BEYOND_RESTART: u32 = 0;

/// Behaviour at a full context: the step is refused (`LADS_STATUS_CONTEXT_FULL`) until `lads_reset`
/// or an instruction.
pub const LADS_BEYOND_REFUSE: u32 = 1;

/// Contract of a policy: its sizes, numbers of channels and texts.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsContract {
    /// Size of the struct: set it to `sizeof(lads_contract)` before the call.
    pub struct_bytes: u32,
    /// Control period, the time from one control step to the next, in seconds.
    pub control_period_s: f32,
    /// Name of the family of policies, for example "lads"; informational, nothing depends on it.
    pub family: LadsText,
    /// Name of the environment, for example "franka-kitchen".
    pub environment: LadsText,
    /// Version of the environment.
    pub environment_version: LadsText,
    /// SHA-256 of the bundle that the image was compiled from, hexadecimal.
    pub bundle_sha256: LadsText,
    /// Language encoder that made the word embeddings; empty without instructions.
    pub encoder: LadsText,
    /// SHA-256 of the language encoder's weights, hexadecimal.
    pub encoder_sha256: LadsText,
    /// Number of channels, see `lads_channel`.
    pub channel_count: u32,
    /// Number of channels that are given in every control step; `lads_step` takes a single one,
    /// `lads_step_channels` any number.
    pub observation_count: u32,
    /// Number of the first observation channel.
    pub observation: u32,
    /// Number of the action's channel.
    pub action: u32,
    /// Number of the channel of word embeddings; `LADS_NONE` for a policy that takes no instruction and needs none.
    pub instruction: u32,
    /// Number of instructions that the policy knows.
    pub instruction_count: u32,
    /// Number of elements of the first observation channel.
    pub observation_len: usize,
    /// Number of elements of an action.
    pub action_len: usize,
    /// Largest number of words of an instruction; 0 for a policy that takes none.
    pub words_len: usize,
    /// Number of elements of a word embedding.
    pub word_dim: usize,
    /// Smallest similarity to a known instruction at which another sentence may be followed, see
    /// `lads_instruction_similarity`; above 1 if none may be.
    pub acceptance: f32,
    /// Number of control steps that a context holds; 0 if it is unbounded.
    pub context_steps: u32,
    /// Behaviour after that many control steps: `LADS_BEYOND_RESTART` or `LADS_BEYOND_REFUSE`.
    pub beyond: u32,
    /// Number of indices, such as those of latent plans, that the policy selects from; 0 for one
    /// that selects nothing.
    pub index_count: u32,
    /// Divisor of the scores when an index is picked at random, unless `lads_set_decision` sets
    /// another one; 0 for argmax.
    pub temperature: f32,
    /// Source of noise, `LADS_NOISE_ZERO` or `LADS_NOISE_SEEDED`, unless `lads_set_noise` sets
    /// another one.
    pub noise: u32,
    /// Seed of the random picks.
    pub decision_seed: u64,
    /// Seed of the noise.
    pub noise_seed: u64,
    /// Largest number of values of noise that a control step takes; 0 for a policy without noise.
    pub noise_len: usize,
    /// Size of the image in bytes; bytes after it are not read.
    pub image_bytes: usize,
    /// Number of multiply-adds of the most expensive control step.
    pub worst_work: u64,
}

impl Default for LadsContract {
    fn default() -> Self {
        let none = LadsText::default();
        Self {
            struct_bytes: size_of::<Self>() as u32,
            control_period_s: 0.0,
            family: none,
            environment: none,
            environment_version: none,
            bundle_sha256: none,
            encoder: none,
            encoder_sha256: none,
            channel_count: 0,
            observation_count: 0,
            observation: LADS_NONE,
            action: LADS_NONE,
            instruction: LADS_NONE,
            instruction_count: 0,
            observation_len: 0,
            action_len: 0,
            words_len: 0,
            word_dim: 0,
            acceptance: 0.0,
            context_steps: 0,
            beyond: LADS_BEYOND_RESTART,
            index_count: 0,
            temperature: 0.0,
            noise: LADS_NOISE_ZERO,
            decision_seed: 0,
            noise_seed: 0,
            noise_len: 0,
            image_bytes: 0,
            worst_work: 0,
        }
    }
}

impl LadsContract {
    pub(crate) fn of(policy: &Policy<'static>) -> Self {
        let contract = policy.contract();
        let (temperature, decision_seed) = match contract.decision() {
            Decision::Argmax => (0.0, 0),
            Decision::Sample { temperature, seed } => (temperature, seed),
        };
        let (noise, noise_seed) = match contract.noise() {
            Noise::Zero => (LADS_NOISE_ZERO, 0),
            Noise::Seeded { seed } => (LADS_NOISE_SEEDED, seed),
        };
        Self {
            struct_bytes: size_of::<Self>() as u32,
            control_period_s: contract.control_period_s(),
            family: LadsText::new(contract.family()),
            environment: LadsText::new(contract.environment_id()),
            environment_version: LadsText::new(contract.environment_version()),
            bundle_sha256: LadsText::new(contract.bundle_sha256()),
            encoder: LadsText::new(contract.encoder()),
            encoder_sha256: LadsText::new(contract.encoder_sha256()),
            channel_count: contract.channels().count() as u32,
            observation_count: contract.observations_len() as u32,
            observation: contract.observation().id().0,
            action: contract.action().id().0,
            instruction: contract
                .instruction_channel()
                .map_or(LADS_NONE, |channel| channel.id().0),
            instruction_count: contract.instruction_count() as u32,
            observation_len: contract.observation_len(),
            action_len: contract.action_len(),
            words_len: contract.words_len(),
            word_dim: contract.word_dim(),
            acceptance: contract.acceptance(),
            context_steps: contract.context_steps().unwrap_or(0) as u32,
            beyond: match contract.beyond() {
                Beyond::Restart => LADS_BEYOND_RESTART,
                Beyond::Refuse => LADS_BEYOND_REFUSE,
            },
            index_count: policy.index_count(),
            temperature,
            noise,
            decision_seed,
            noise_seed,
            noise_len: policy.noise_len(),
            image_bytes: policy.image_bytes(),
            worst_work: contract.worst_work(),
        }
    }
}

/// Role of a channel that the caller gives in every control step.
pub const LADS_ROLE_OBSERVATION: u32 = 0;

/// Role of a channel that every control step writes.
pub const LADS_ROLE_ACTION: u32 = 1;

/// Role of a channel of word embeddings, `[words, elements]`.
pub const LADS_ROLE_INSTRUCTION: u32 = 2;

/// Role of a channel of random numbers, drawn by the library unless `lads_step_channels` is given
/// them.
pub const LADS_ROLE_NOISE: u32 = 3;

/// Role of a channel that holds a piece of a demonstration.
pub const LADS_ROLE_DEMONSTRATION: u32 = 4;

/// Type of 32-bit floats.
pub const LADS_F32: u32 = 0;

/// Type of bytes, such as the pixels of a camera.
pub const LADS_U8: u32 = 1;

/// Type of signed 32-bit integers.
pub const LADS_I32: u32 = 2;

/// Order of quaternions for a channel without any.
pub const LADS_QUATERNIONS_NONE: u32 = 0;

/// Order of quaternions with the scalar first.
pub const LADS_QUATERNIONS_WXYZ: u32 = 1;

/// Order of quaternions with the scalar last.
pub const LADS_QUATERNIONS_XYZW: u32 = 2;

/// Largest number of axes of a channel.
pub const LADS_MAX_RANK: usize = 4;

/// One channel: an input or output of the policy.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsChannel {
    /// Size of the struct: set it to `sizeof(lads_channel_t)` before the call.
    pub struct_bytes: u32,
    /// Role of the channel: `LADS_ROLE_OBSERVATION`, `_ACTION`, `_INSTRUCTION`, `_NOISE` or
    /// `_DEMONSTRATION`.
    pub role: u32,
    /// Type of the channel's elements: `LADS_F32`, `LADS_U8` or `LADS_I32`.
    pub dtype: u32,
    /// Number of axes, 1 to 4.
    pub rank: u32,
    /// Lengths of the axes; 1 beyond the rank.
    pub dims: [u32; LADS_MAX_RANK],
    /// Number of elements, which are in the order of the axes.
    pub len: usize,
    /// Name of the channel.
    pub name: LadsText,
    /// Description of the reference that the values are relative to, such as "the observed joint
    /// position"; empty where the bundle does not say.
    pub reference: LadsText,
    /// Order of the components of the channel's quaternions: `LADS_QUATERNIONS_NONE`, `_WXYZ` or
    /// `_XYZW`.
    pub quaternions: u32,
    /// 1 if the elements have names and units, 0 for images and the like, whose elements are alike.
    pub described: u32,
}

impl Default for LadsChannel {
    fn default() -> Self {
        Self {
            struct_bytes: size_of::<Self>() as u32,
            role: LADS_NONE,
            dtype: LADS_NONE,
            rank: 0,
            dims: [1; LADS_MAX_RANK],
            len: 0,
            name: LadsText::default(),
            reference: LadsText::default(),
            quaternions: LADS_QUATERNIONS_NONE,
            described: 0,
        }
    }
}

/// Returns the number by which C knows a type.
pub(crate) fn dtype(dtype: DType) -> u32 {
    match dtype {
        DType::F32 => LADS_F32,
        DType::U8 => LADS_U8,
        DType::I32 => LADS_I32,
    }
}

impl LadsChannel {
    pub(crate) fn new(channel: &Channel<'static>) -> Self {
        let mut dims = [1; LADS_MAX_RANK];
        for (to, &dim) in dims.iter_mut().zip(channel.shape()) {
            *to = dim;
        }
        Self {
            struct_bytes: size_of::<Self>() as u32,
            role: match channel.role() {
                Role::Observation => LADS_ROLE_OBSERVATION,
                Role::Action => LADS_ROLE_ACTION,
                Role::Instruction => LADS_ROLE_INSTRUCTION,
                Role::Noise => LADS_ROLE_NOISE,
                Role::Demonstration => LADS_ROLE_DEMONSTRATION,
            },
            dtype: dtype(channel.dtype()),
            rank: channel.shape().len() as u32,
            dims,
            len: channel.len(),
            name: LadsText::new(channel.name()),
            reference: LadsText::new(channel.reference()),
            quaternions: match channel.quaternion_order() {
                QuaternionOrder::None => LADS_QUATERNIONS_NONE,
                QuaternionOrder::Wxyz => LADS_QUATERNIONS_WXYZ,
                QuaternionOrder::Xyzw => LADS_QUATERNIONS_XYZW,
            },
            described: u32::from(channel.elements().next().is_some()),
        }
    }
}

/// One element of a channel. Its physical value is reference + offset + scale * value, where the
/// reference is the channel's for this joint.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsElement {
    /// Size of the struct: set it to `sizeof(lads_element)` before the call.
    pub struct_bytes: u32,
    /// Smallest value, before scale and offset.
    pub min: f32,
    /// Largest value, before scale and offset.
    pub max: f32,
    /// Physical value of one unit of the element.
    pub scale: f32,
    /// Physical value for an element of zero, without the channel's reference.
    pub offset: f32,
    /// Name of the element; empty for an element of a channel without descriptions.
    pub name: LadsText,
    /// Unit of the element; "1" for a dimensionless one.
    pub unit: LadsText,
    /// Joint that the element belongs to; empty for none.
    pub joint: LadsText,
    /// Quantity of the joint: "position", "velocity", "effort"; empty where the bundle does not
    /// say.
    pub interface: LadsText,
    /// Unit of the physical value; empty where the bundle does not say.
    pub physical_unit: LadsText,
}

impl Default for LadsElement {
    fn default() -> Self {
        Self {
            struct_bytes: size_of::<Self>() as u32,
            min: 0.0,
            max: 0.0,
            scale: 1.0,
            offset: 0.0,
            name: LadsText::default(),
            unit: LadsText::new("1"),
            joint: LadsText::default(),
            interface: LadsText::default(),
            physical_unit: LadsText::default(),
        }
    }
}

impl LadsElement {
    pub(crate) fn new(element: &Element<'static>) -> Self {
        Self {
            struct_bytes: size_of::<Self>() as u32,
            min: element.limits.min,
            max: element.limits.max,
            scale: element.scale,
            offset: element.offset,
            name: LadsText::new(element.name),
            unit: LadsText::new(element.unit),
            joint: LadsText::new(element.joint),
            interface: LadsText::new(element.interface),
            physical_unit: LadsText::new(element.physical_unit),
        }
    }

    /// Makes the description of one of many elements that are alike.
    pub(crate) fn alike(limits: Interval) -> Self {
        Self {
            min: limits.min,
            max: limits.max,
            ..Self::default()
        }
    }
}

/// One instruction that a policy knows.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsInstruction {
    /// Size of the struct: set it to `sizeof(lads_instruction)` before the call.
    pub struct_bytes: u32,
    /// Short name of the instruction.
    pub id: LadsText,
    /// The instruction as a person says it.
    pub text: LadsText,
    /// Number of words.
    pub words_len: usize,
}

impl Default for LadsInstruction {
    fn default() -> Self {
        Self {
            struct_bytes: size_of::<Self>() as u32,
            id: LadsText::default(),
            text: LadsText::default(),
            words_len: 0,
        }
    }
}

impl LadsInstruction {
    pub(crate) fn new(known: &KnownInstruction<'static>, word_dim: usize) -> Self {
        Self {
            struct_bytes: size_of::<Self>() as u32,
            id: LadsText::new(known.id),
            text: LadsText::new(known.text),
            words_len: known.words.len().checked_div(word_dim).unwrap_or(0),
        }
    }
}

versioned!(LadsContract, LadsChannel, LadsElement, LadsInstruction);
