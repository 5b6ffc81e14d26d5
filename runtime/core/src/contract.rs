//! What a policy expects and promises: its channels, their names, units and limits, and the instructions that it knows.
//!
//! A [`Contract`] is a view on the image, checked when the policy is opened; its accessors cannot fail, those with an index
//! give `None` beyond the end.

use core::error::Error;
use core::fmt;

use lads_image::codec::{Field, Reader};
use lads_image::records::{
    self, ChannelRecord, ContractRecord, ElementRecord, InstructionRecord, NoiseRule, SelectionRule,
};
use lads_image::tables::Tables;

use crate::inputs::MAX_OBSERVATIONS;

/// The most elements that a channel may have: an image of 4,096 by 4,096 pixels of four colours is within it.
const MAX_CHANNEL_LEN: u64 = 1 << 26;

/// The most channels that a policy may have.
const MAX_CHANNELS: usize = 128;

/// A checked view on the contract of a policy.
#[derive(Debug, Clone, Copy)]
pub struct Contract<'a> {
    pub(crate) tables: Tables<'a>,
    record: ContractRecord,
    /// The first observation channel.
    observation: u32,
    observations_len: u32,
    action: u32,
    action_len: u32,
    instruction: Option<u32>,
    noise: Option<u32>,
}

/// Which channel of a policy: its position among [`Contract::channels`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ChannelId(pub u32);

/// What a channel is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Role {
    /// Given by the caller in every control step.
    Observation,
    /// Written by every control step.
    Action,
    /// Word embeddings, `[words, elements]`.
    Instruction,
    /// Random numbers: each run of a program that reads the channel takes a draw of its own.
    Noise,
    /// A piece of a demonstration, given to [`Controller::encode`](crate::Controller::encode).
    Demonstration,
}

/// The type of a channel's elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DType {
    /// 32-bit floats.
    F32,
    /// Bytes, such as the pixels of a camera.
    U8,
    /// Signed 32-bit integers.
    I32,
}

/// What happens when a context has seen as many control steps as the policy was trained on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Beyond {
    /// The instruction stays in the context, the timestep starts again at 0.
    Restart,
    /// The step is refused.
    Refuse,
}

/// Order of the components of the quaternions in a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum QuaternionOrder {
    /// There are none.
    None,
    /// Scalar first.
    Wxyz,
    /// Scalar last.
    Xyzw,
}

/// One channel: a value at the policy's edge.
#[derive(Debug, Clone, Copy)]
pub struct Channel<'a> {
    tables: Tables<'a>,
    record: ChannelRecord,
    id: ChannelId,
}

/// One element of a channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Element<'a> {
    /// Name.
    pub name: &'a str,
    /// Unit, `1` for none.
    pub unit: &'a str,
    /// Joint that it belongs to; empty for none.
    pub joint: &'a str,
    /// What of the joint: `position`, `velocity`, `effort`; empty where the bundle does not say.
    pub interface: &'a str,
    /// Unit of the physical value that the element stands for; empty where the bundle does not say.
    pub physical_unit: &'a str,
    /// Physical value of one unit of the element: physical = reference + offset + scale * value.
    pub scale: f32,
    /// Physical value of zero, on top of the channel's reference.
    pub offset: f32,
    /// What the contract allows.
    pub limits: Interval,
}

/// The smallest and the largest value of one element, in its unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    /// The smallest value.
    pub min: f32,
    /// The largest value.
    pub max: f32,
}

impl Interval {
    /// The value, or the limit beyond which it lies. What is not a number stays so.
    #[inline]
    pub fn clamp(self, value: f32) -> f32 {
        // `f32::clamp` without its panic on limits in the wrong order, which a checked contract does not have; two selections and
        // no branch, so that a control step takes the same instructions whatever the action.
        let raised = if value < self.min { self.min } else { value };
        if raised > self.max { self.max } else { raised }
    }
}

/// One instruction that a policy knows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownInstruction<'a> {
    /// Short name.
    pub id: &'a str,
    /// What the person says.
    pub text: &'a str,
    /// `[n, E]` word embeddings.
    pub words: &'a [f32],
}

/// How an index is picked from scores.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Decision {
    /// The largest score, the first of equal ones.
    Argmax,
    /// At random with the softmax of the scores over the temperature. A temperature that is not above zero means argmax.
    Sample {
        /// Divides the scores.
        temperature: f32,
        /// The same seed gives the same indices.
        seed: u64,
    },
}

/// Where the values of noise channels come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Noise {
    /// Zeros, the mean of what would be drawn.
    Zero,
    /// Standard normals; the same seed gives the same values, on every target.
    Seeded {
        /// Of the generator.
        seed: u64,
    },
}

impl<'a> Contract<'a> {
    /// Checks what the tables say at the policy's edge.
    pub(crate) fn new_checked(tables: Tables<'a>) -> Result<Self, ContractError> {
        let record = tables.contract().ok_or(ContractError::Number)?;
        let positive = |x: f32| x.is_finite() && x > 0.0;
        if !positive(record.control_period_s)
            || !positive(record.temperature)
            || !record.acceptance.is_finite()
        {
            return Err(ContractError::Number);
        }
        let mut contract = Self {
            tables,
            record,
            observation: records::NONE,
            observations_len: 0,
            action: records::NONE,
            action_len: 0,
            instruction: None,
            noise: None,
        };
        if tables.channels_len() > MAX_CHANNELS {
            return Err(ContractError::Channels);
        }
        let mut elements = 0_u32;
        for (i, channel) in (0_u32..).zip(contract.channels()) {
            channel.check(elements)?;
            elements = elements.saturating_add(channel.record.elements_len);
            match channel.role() {
                Role::Observation => {
                    if contract.observations_len == 0 {
                        contract.observation = i;
                    }
                    contract.observations_len = contract.observations_len.saturating_add(1);
                }
                Role::Action => {
                    let twice = contract.action != records::NONE;
                    if twice || channel.dtype() != DType::F32 {
                        return Err(ContractError::Channels);
                    }
                    contract.action = i;
                    contract.action_len = channel.len() as u32;
                }
                Role::Instruction => {
                    let words = channel.dtype() == DType::F32 && channel.shape().len() == 2;
                    if contract.instruction.is_some() || !words {
                        return Err(ContractError::Channels);
                    }
                    contract.instruction = Some(i);
                }
                Role::Noise => {
                    if contract.noise.is_some() || channel.dtype() != DType::F32 {
                        return Err(ContractError::Channels);
                    }
                    contract.noise = Some(i);
                }
                Role::Demonstration => {
                    if channel.dtype() != DType::F32 {
                        return Err(ContractError::Channels);
                    }
                }
            }
        }
        let observations = 1..=MAX_OBSERVATIONS;
        let complete =
            observations.contains(&contract.observations_len()) && contract.action != records::NONE;
        if !complete || elements as usize != tables.elements_len() {
            return Err(ContractError::Channels);
        }
        contract.check_instructions()?;
        Ok(contract)
    }

    fn check_instructions(&self) -> Result<(), ContractError> {
        let (most, dim) = (self.words_len(), self.word_dim());
        for i in 0..self.tables.instructions_len() {
            let known = self.tables.instruction(i).ok_or(ContractError::Words)?;
            let len = (known.words_len as usize).checked_mul(dim);
            let fits = (1..=most).contains(&(known.words_len as usize))
                && len == Some(known.words.len as usize);
            if !fits {
                return Err(ContractError::Words);
            }
        }
        Ok(())
    }

    /// Name of the family of policies that this one belongs to, such as `lads`: to be shown, nothing depends on it.
    pub fn family(&self) -> &'a str {
        self.tables.text(self.record.family)
    }

    /// Environment, for example `franka-kitchen`.
    pub fn environment_id(&self) -> &'a str {
        self.tables.text(self.record.environment_id)
    }

    /// The environment's version.
    pub fn environment_version(&self) -> &'a str {
        self.tables.text(self.record.environment_version)
    }

    /// Time from one control step to the next, in seconds.
    pub fn control_period_s(&self) -> f32 {
        self.record.control_period_s
    }

    /// All channels, in the order of their [`ChannelId`]s.
    pub fn channels(&self) -> impl Iterator<Item = Channel<'a>> + use<'a> {
        let contract = *self;
        (0_u32..)
            .take(self.tables.channels_len())
            .filter_map(move |i| contract.channel(ChannelId(i)))
    }

    /// A channel by its number.
    #[inline]
    pub fn channel(&self, id: ChannelId) -> Option<Channel<'a>> {
        Some(Channel {
            tables: self.tables,
            record: self.tables.channel(id.0 as usize)?,
            id,
        })
    }

    /// A channel by its name.
    pub fn find(&self, name: &str) -> Option<Channel<'a>> {
        self.channels()
            .find(|channel| same_text(channel.name(), name))
    }

    /// The channels that the caller gives in every control step.
    pub fn observations(&self) -> impl Iterator<Item = Channel<'a>> + use<'a> {
        self.channels()
            .filter(|channel| channel.role() == Role::Observation)
    }

    /// How many channels the caller gives in every control step; one or more.
    pub fn observations_len(&self) -> usize {
        self.observations_len as usize
    }

    /// The first observation channel, the only one of most policies.
    pub fn observation(&self) -> Channel<'a> {
        self.known(self.observation)
    }

    /// Elements of the first observation channel.
    pub fn observation_len(&self) -> usize {
        self.observation().len()
    }

    /// The action channel.
    pub fn action(&self) -> Channel<'a> {
        self.known(self.action)
    }

    /// Elements of an action.
    #[inline]
    pub fn action_len(&self) -> usize {
        self.action_len as usize
    }

    /// The limits of the action's elements.
    #[inline]
    pub fn action_limits(&self) -> impl Iterator<Item = Interval> + use<'a> {
        self.action().limits()
    }

    /// A channel that [`new_checked`](Self::new_checked) has found.
    fn known(&self, i: u32) -> Channel<'a> {
        Channel {
            tables: self.tables,
            record: self.tables.channel(i as usize).unwrap_or(EMPTY),
            id: ChannelId(i),
        }
    }

    /// The channel of word embeddings; `None` for a policy that takes no instruction.
    pub fn instruction_channel(&self) -> Option<Channel<'a>> {
        self.channel(ChannelId(self.instruction?))
    }

    /// The channel of random numbers; `None` for a policy that takes none.
    pub fn noise_channel(&self) -> Option<Channel<'a>> {
        self.channel(ChannelId(self.noise?))
    }

    /// Words of the longest instruction; 0 for a policy that takes none.
    pub fn words_len(&self) -> usize {
        self.words_shape(0)
    }

    /// Elements of a word embedding; 0 for a policy that takes no instruction.
    pub fn word_dim(&self) -> usize {
        self.words_shape(1)
    }

    fn words_shape(&self, axis: usize) -> usize {
        self.instruction_channel()
            .and_then(|channel| channel.record.dims.get(axis).copied())
            .unwrap_or(0) as usize
    }

    /// Control steps that a context holds; `None` when it has no such bound.
    pub fn context_steps(&self) -> Option<usize> {
        let steps = self.record.context_steps as usize;
        (steps > 0).then_some(steps)
    }

    /// What happens after [`context_steps`](Self::context_steps) control steps.
    pub fn beyond(&self) -> Beyond {
        match self.record.beyond {
            records::Beyond::Restart => Beyond::Restart,
            records::Beyond::Refuse => Beyond::Refuse,
        }
    }

    /// How an index is picked unless the caller says otherwise.
    pub fn decision(&self) -> Decision {
        match self.record.selection {
            SelectionRule::Argmax => Decision::Argmax,
            SelectionRule::Sample => Decision::Sample {
                temperature: self.record.temperature,
                seed: self.record.selection_seed,
            },
        }
    }

    /// Where noise comes from unless the caller says otherwise.
    pub fn noise(&self) -> Noise {
        match self.record.noise {
            NoiseRule::Zero => Noise::Zero,
            NoiseRule::Seeded => Noise::Seeded {
                seed: self.record.noise_seed,
            },
        }
    }

    /// Language encoder that made the word embeddings; empty without instructions.
    pub fn encoder(&self) -> &'a str {
        self.tables.text(self.record.encoder)
    }

    /// SHA-256 of the language encoder's weights, hexadecimal.
    pub fn encoder_sha256(&self) -> &'a str {
        self.tables.text(self.record.encoder_sha256)
    }

    /// Similarity to a known instruction from which other sentences may be followed; above 1 when none may be.
    pub fn acceptance(&self) -> f32 {
        self.record.acceptance
    }

    /// SHA-256 of the bundle that the image was compiled from, hexadecimal.
    pub fn bundle_sha256(&self) -> &'a str {
        self.tables.text(self.record.bundle_sha256)
    }

    /// Multiply-adds that the image says its most expensive control step takes, or the calls of another event if they take more.
    pub fn worst_work(&self) -> u64 {
        self.record.worst_work
    }

    /// How many instructions the policy knows.
    pub fn instruction_count(&self) -> usize {
        self.tables.instructions_len()
    }

    /// The instructions that the policy knows, in the order of their numbers.
    pub fn instructions(&self) -> impl Iterator<Item = KnownInstruction<'a>> + use<'a> {
        let contract = *self;
        (0..self.instruction_count()).filter_map(move |i| contract.instruction(i))
    }

    /// Instruction number `i`.
    pub fn instruction(&self, i: usize) -> Option<KnownInstruction<'a>> {
        let InstructionRecord {
            id, text, words, ..
        } = self.tables.instruction(i)?;
        Some(KnownInstruction {
            id: self.tables.text(id),
            text: self.tables.text(text),
            words: self.tables.span(words),
        })
    }
}

/// Whether two texts are the same. Byte by byte: comparing slices would call `bcmp`, which not every target has.
pub(crate) fn same_text(a: &str, b: &str) -> bool {
    a.bytes().eq(b.bytes())
}

/// Stands for a channel that is not there, which no checked contract asks for.
const EMPTY: ChannelRecord = ChannelRecord {
    name: records::Text { offset: 0, len: 0 },
    role: records::Role::Observation,
    dtype: records::DType::F32,
    rank: 1,
    dims: [0, 1, 1, 1],
    quaternions: records::QuaternionOrder::None,
    reference: records::Text { offset: 0, len: 0 },
    first_element: 0,
    elements_len: 0,
    min: 0.0,
    max: 0.0,
};

impl Element<'_> {
    /// Whether another element means the same, limits included.
    pub(crate) fn is_like(&self, other: &Element) -> bool {
        fn texts<'e>(element: &Element<'e>) -> [&'e str; 4] {
            [element.name, element.unit, element.joint, element.interface]
        }
        fn numbers(element: &Element) -> [u32; 4] {
            let Interval { min, max } = element.limits;
            [element.scale, element.offset, min, max].map(f32::to_bits)
        }
        let mut both = texts(self).into_iter().zip(texts(other));
        both.all(|(a, b)| same_text(a, b)) && numbers(self).iter().eq(&numbers(other))
    }
}

impl<'a> Channel<'a> {
    /// Whether another channel means the same to those who give observations and execute actions.
    pub(crate) fn is_like(&self, other: &Channel) -> bool {
        let (mut mine, mut theirs) = (self.elements(), other.elements());
        let elements = loop {
            match (mine.next(), theirs.next()) {
                (None, None) => break true,
                (Some(a), Some(b)) if a.is_like(&b) => {}
                _ => break false,
            }
        };
        let alike = |channel: &Channel| [channel.record.min, channel.record.max].map(f32::to_bits);
        let ([min, max], [their_min, their_max]) = (alike(self), alike(other));
        elements
            && self.role() == other.role()
            && self.dtype() == other.dtype()
            && self.quaternion_order() == other.quaternion_order()
            && self.shape().iter().eq(other.shape())
            && same_text(self.name(), other.name())
            && same_text(self.reference(), other.reference())
            && (min == their_min && max == their_max)
    }

    /// `elements` is the number of element records of the channels before this one.
    fn check(&self, elements: u32) -> Result<(), ContractError> {
        let c = &self.record;
        let shape = self.shape();
        let len: u64 = shape.iter().fold(1, |len: u64, &dim| {
            len.saturating_mul(u64::from(dim))
                .min(MAX_CHANNEL_LEN.saturating_add(1))
        });
        let beyond = c.dims.get(shape.len()..).unwrap_or(&[]);
        let shaped = (1..=4).contains(&c.rank)
            && (1..=MAX_CHANNEL_LEN).contains(&len)
            && beyond.iter().all(|&dim| dim == 1);
        let described = c.elements_len == 0
            || (c.first_element == elements && u64::from(c.elements_len) == len);
        if !shaped || !described || self.name().is_empty() {
            return Err(ContractError::Shape { channel: self.id });
        }
        let ordered = |min: f32, max: f32| min.is_finite() && max.is_finite() && min <= max;
        let limits = ordered(c.min, c.max)
            && self.elements().all(|element| {
                ordered(element.limits.min, element.limits.max)
                    && element.scale.is_finite()
                    && element.offset.is_finite()
            });
        let exact = self.dtype() == DType::F32 || c.elements_len == 0;
        let others = self.tables.channels_len().min(self.id.0 as usize);
        let twice = (0..others).any(|i| {
            self.tables
                .channel(i)
                .is_some_and(|other| same_text(self.tables.text(other.name), self.name()))
        });
        if !limits || !exact {
            return Err(ContractError::Limits { channel: self.id });
        }
        if twice {
            return Err(ContractError::Channels);
        }
        Ok(())
    }

    /// Its number.
    pub fn id(&self) -> ChannelId {
        self.id
    }

    /// Name.
    pub fn name(&self) -> &'a str {
        self.tables.text(self.record.name)
    }

    /// What it is for.
    pub fn role(&self) -> Role {
        match self.record.role {
            records::Role::Observation => Role::Observation,
            records::Role::Action => Role::Action,
            records::Role::Instruction => Role::Instruction,
            records::Role::Noise => Role::Noise,
            records::Role::Demonstration => Role::Demonstration,
        }
    }

    /// Type of its elements.
    pub fn dtype(&self) -> DType {
        match self.record.dtype {
            records::DType::F32 => DType::F32,
            records::DType::U8 => DType::U8,
            records::DType::I32 => DType::I32,
        }
    }

    /// Lengths of its axes, one to four.
    pub fn shape(&self) -> &[u32] {
        let rank = self.record.rank as usize;
        self.record.dims.get(..rank).unwrap_or(&self.record.dims)
    }

    /// Elements.
    #[inline]
    #[expect(
        clippy::len_without_is_empty,
        reason = "a channel has an element at least"
    )]
    pub fn len(&self) -> usize {
        let [a, b, c, d] = self.record.dims.map(|dim| dim as usize);
        a.saturating_mul(b).saturating_mul(c).saturating_mul(d)
    }

    /// Order of the components of its quaternions.
    pub fn quaternion_order(&self) -> QuaternionOrder {
        match self.record.quaternions {
            records::QuaternionOrder::None => QuaternionOrder::None,
            records::QuaternionOrder::Wxyz => QuaternionOrder::Wxyz,
            records::QuaternionOrder::Xyzw => QuaternionOrder::Xyzw,
        }
    }

    /// What the values are relative to, in words; empty where the bundle does not say.
    pub fn reference(&self) -> &'a str {
        self.tables.text(self.record.reference)
    }

    /// Its elements with names and units; none for images and the like, whose [`limits`](Self::limits) are alike.
    pub fn elements(&self) -> impl Iterator<Item = Element<'a>> + use<'a> {
        let tables = self.tables;
        tables.elements(&self.record).iter().filter_map(move |row| {
            let record = ElementRecord::take(&mut Reader::new(row))?;
            Some(Element {
                name: tables.text(record.name),
                unit: tables.text(record.unit),
                joint: tables.text(record.joint),
                interface: tables.text(record.interface),
                physical_unit: tables.text(record.physical_unit),
                scale: record.scale,
                offset: record.offset,
                limits: Interval {
                    min: record.min,
                    max: record.max,
                },
            })
        })
    }

    /// Element `i`.
    pub fn element(&self, i: usize) -> Option<Element<'a>> {
        self.elements().nth(i)
    }

    /// The limits of its elements. Reads no text, so it is what a control step looks at.
    #[inline]
    pub fn limits(&self) -> impl Iterator<Item = Interval> + use<'a> {
        let own = self.tables.elements(&self.record);
        let alike = Interval {
            min: self.record.min,
            max: self.record.max,
        };
        // The limits are the last two words of an element's record.
        own.iter()
            .map(|&[.., min, max]| Interval {
                min: f32::from_bits(min),
                max: f32::from_bits(max),
            })
            .chain(core::iter::repeat_n(
                alike,
                if own.is_empty() { self.len() } else { 0 },
            ))
    }
}

/// Why a contract was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ContractError {
    /// The control period, the temperature or the acceptance threshold is not a number that makes sense.
    Number,
    /// No observation or more than a step has room for, no action, more than one action, instruction or noise, too many channels
    /// in all, a name twice, or a role whose elements have the wrong type.
    Channels,
    /// The shape of a channel makes no sense, or its elements are not as many.
    Shape {
        /// Which one.
        channel: ChannelId,
    },
    /// The limits of a channel are not ordered numbers.
    Limits {
        /// Which one.
        channel: ChannelId,
    },
    /// An instruction has no words, or more than the instruction channel holds.
    Words,
}

impl fmt::Display for ContractError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Number => f.write_str(
                "the control period, the temperature or the acceptance threshold makes no sense",
            ),
            Self::Channels => f.write_str(
                "the channels are not observations and one action, each with a name of its own",
            ),
            Self::Shape { channel } => {
                write!(f, "the shape of channel {} makes no sense", channel.0)
            }
            Self::Limits { channel } => {
                write!(
                    f,
                    "the limits of channel {} are not ordered numbers",
                    channel.0
                )
            }
            Self::Words => f.write_str(
                "an instruction has no words, or more than the instruction channel holds",
            ),
        }
    }
}

impl Error for ContractError {}
