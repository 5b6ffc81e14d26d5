//! The contract of a policy: its channels, their names, units and limits, and the instructions that
//! it knows.
//!
//! A [`Contract`] is a view on the image, checked when the policy is opened; its accessors cannot
//! fail; those that take an index return `None` past the end.

use core::error::Error;
use core::fmt;

use lads_image::records::{self, ContractRecord, NoiseRule, SelectionRule};
use lads_image::tables::Tables;

use crate::errors::InputError;
use crate::inputs::{self, Data, MAX_OBSERVATIONS};

mod channel;
mod language;

pub(crate) use channel::Bounds;
pub use channel::{Channel, ChannelId, DType, Element, Interval, QuaternionOrder, Role};
pub use language::KnownInstruction;

/// Largest number of channels that a policy may have.
const MAX_CHANNELS: usize = 128;

/// A checked view on the contract of a policy.
#[derive(Debug, Clone, Copy)]
pub struct Contract<'a> {
    pub(crate) tables: Tables<'a>,
    record: ContractRecord,
    /// Number of the first observation channel.
    observation: u32,
    observations_len: u32,
    observation_dtype: DType,
    observation_bounds: Bounds<'a>,
    action: u32,
    action_bounds: Bounds<'a>,
    instruction: Option<u32>,
    noise: Option<u32>,
}

/// Behaviour once a context has seen as many control steps as the policy was trained on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Beyond {
    /// Restart the timestep at 0 and keep the instruction in the context.
    Restart,
    /// Refuse the step.
    Refuse,
}

/// Rule by which an index is picked from scores.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Decision {
    /// The index with the largest score, the first of equal ones.
    Argmax,
    /// An index drawn at random with the softmax of the scores over the temperature. A temperature
    /// that is not above zero means argmax.
    Sample {
        /// Divisor of the scores.
        temperature: f32,
        /// Seed of the generator; the same seed gives the same indices.
        seed: u64,
    },
}

/// Source of the values of noise channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Noise {
    /// Zeros, the mean of the standard normal distribution.
    Zero,
    /// Standard normals; the same seed gives the same values, on every target.
    Seeded {
        /// Seed of the generator.
        seed: u64,
    },
}

impl<'a> Contract<'a> {
    /// Checks the tables' description of the policy's channels and instructions.
    #[inline(never)]
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
            observation_dtype: DType::F32,
            observation_bounds: Bounds::NONE,
            action: records::NONE,
            action_bounds: Bounds::NONE,
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
                        contract.observation_dtype = channel.dtype();
                        contract.observation_bounds = channel.bounds();
                    }
                    contract.observations_len = contract.observations_len.saturating_add(1);
                }
                Role::Action => {
                    let twice = contract.action != records::NONE;
                    if twice || channel.dtype() != DType::F32 {
                        return Err(ContractError::Channels);
                    }
                    contract.action = i;
                    contract.action_bounds = channel.bounds();
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

    /// Returns the name of the family of policies that this one belongs to, such as `lads`;
    /// informational, nothing depends on it.
    pub fn family(&self) -> &'a str {
        self.tables.text(self.record.family)
    }

    /// Returns the name of the environment, for example `franka-kitchen`.
    pub fn environment_id(&self) -> &'a str {
        self.tables.text(self.record.environment_id)
    }

    /// Returns the version of the environment.
    pub fn environment_version(&self) -> &'a str {
        self.tables.text(self.record.environment_version)
    }

    /// Returns the control period, the time from one control step to the next, in seconds.
    pub fn control_period_s(&self) -> f32 {
        self.record.control_period_s
    }

    /// Returns all channels, in the order of their [`ChannelId`]s.
    pub fn channels(&self) -> impl Iterator<Item = Channel<'a>> + use<'a> {
        let contract = *self;
        (0_u32..)
            .take(self.tables.channels_len())
            .filter_map(move |i| contract.channel(ChannelId(i)))
    }

    /// Returns the channel with this number.
    #[inline]
    pub fn channel(&self, id: ChannelId) -> Option<Channel<'a>> {
        let record = self.tables.channel(id.0 as usize)?;
        Some(Channel::new(self.tables, record, id))
    }

    /// Returns the channel with this name.
    pub fn find(&self, name: &str) -> Option<Channel<'a>> {
        self.channels()
            .find(|channel| same_text(channel.name(), name))
    }

    /// Returns the channels that the caller gives in every control step.
    pub fn observations(&self) -> impl Iterator<Item = Channel<'a>> + use<'a> {
        self.channels()
            .filter(|channel| channel.role() == Role::Observation)
    }

    /// Returns the number of channels that the caller gives in every control step; one or more.
    pub fn observations_len(&self) -> usize {
        self.observations_len as usize
    }

    /// Returns the first observation channel, the only one of most policies.
    pub fn observation(&self) -> Channel<'a> {
        self.known(self.observation)
    }

    /// Checks whether a control step would accept these values: all observation channels once, each
    /// with finite values inside its limits.
    pub fn check_observations(&self, given: &[(ChannelId, Data)]) -> Result<(), InputError> {
        inputs::check(self, Role::Observation, given, 0).map(|_| ())
    }

    /// Returns the number of elements of the first observation channel.
    pub fn observation_len(&self) -> usize {
        self.observation().len()
    }

    /// Returns the action channel.
    pub fn action(&self) -> Channel<'a> {
        self.known(self.action)
    }

    /// Returns the number of elements of an action.
    #[inline]
    pub fn action_len(&self) -> usize {
        self.action_bounds.len
    }

    /// Returns the limits of all elements of the action.
    #[inline]
    pub(crate) fn action_bounds(&self) -> Bounds<'a> {
        self.action_bounds
    }

    /// Returns the number of the action channel.
    #[inline]
    pub(crate) fn action_id(&self) -> u32 {
        self.action
    }

    /// Returns the number of the noise channel.
    #[inline]
    pub(crate) fn noise_id(&self) -> Option<u32> {
        self.noise
    }

    /// Returns the only observation channel, if it is one of floats.
    #[inline]
    pub(crate) fn only_observation(&self) -> Result<ChannelId, InputError> {
        let id = ChannelId(self.observation);
        if self.observation_dtype != DType::F32 {
            return Err(InputError::Type { channel: id.0 });
        }
        if self.observations_len > 1 {
            let other = self
                .observations()
                .nth(1)
                .map_or(id, |channel| channel.id());
            return Err(InputError::Missing { channel: other.0 });
        }
        Ok(id)
    }

    /// Checks the values of the only observation channel.
    #[inline]
    pub(crate) fn check_only(&self, values: &[f32]) -> Result<(), InputError> {
        self.observation_bounds
            .check(ChannelId(self.observation), values)
    }

    /// Returns the limits of the action's elements.
    #[inline]
    pub fn action_limits(&self) -> impl Iterator<Item = Interval> + use<'a> {
        self.action_bounds.iter()
    }

    /// Returns a channel that [`new_checked`](Self::new_checked) has found.
    fn known(&self, i: u32) -> Channel<'a> {
        let record = self.tables.channel(i as usize);
        Channel::new(self.tables, record.unwrap_or(channel::EMPTY), ChannelId(i))
    }

    /// Returns the channel of word embeddings; `None` for a policy that takes no instruction.
    pub fn instruction_channel(&self) -> Option<Channel<'a>> {
        self.channel(ChannelId(self.instruction?))
    }

    /// Returns the channel of random numbers; `None` for a policy that takes none.
    pub fn noise_channel(&self) -> Option<Channel<'a>> {
        self.channel(ChannelId(self.noise?))
    }

    /// Returns the number of control steps that a context holds; `None` if it is unbounded.
    pub fn context_steps(&self) -> Option<usize> {
        let steps = self.record.context_steps as usize;
        (steps > 0).then_some(steps)
    }

    /// Returns the behaviour after [`context_steps`](Self::context_steps) control steps.
    pub fn beyond(&self) -> Beyond {
        match self.record.beyond {
            records::Beyond::Restart => Beyond::Restart,
            records::Beyond::Refuse => Beyond::Refuse,
        }
    }

    /// Returns the rule that picks an index unless the caller sets another one.
    pub fn decision(&self) -> Decision {
        match self.record.selection {
            SelectionRule::Argmax => Decision::Argmax,
            SelectionRule::Sample => Decision::Sample {
                temperature: self.record.temperature,
                seed: self.record.selection_seed,
            },
        }
    }

    /// Returns the rule that draws indices with a seed, at the temperature of the contract's rule, or
    /// at 1 where that is argmax.
    pub fn sampling(&self, seed: u64) -> Decision {
        let temperature = match self.decision() {
            Decision::Sample { temperature, .. } => temperature,
            Decision::Argmax => 1.0,
        };
        Decision::Sample { temperature, seed }
    }

    /// Returns the source of noise unless the caller sets another one.
    pub fn noise(&self) -> Noise {
        match self.record.noise {
            NoiseRule::Zero => Noise::Zero,
            NoiseRule::Seeded => Noise::Seeded {
                seed: self.record.noise_seed,
            },
        }
    }

    /// Returns the SHA-256 of the bundle that the image was compiled from, hexadecimal.
    pub fn bundle_sha256(&self) -> &'a str {
        self.tables.text(self.record.bundle_sha256)
    }

    /// Returns the multiply-adds of the policy's most expensive control step, or of the calls of
    /// another event if they take more, as the image states them.
    pub fn worst_work(&self) -> u64 {
        self.record.worst_work
    }
}

/// Returns whether two texts are the same. Byte by byte: comparing slices would call `bcmp`, which
/// not every target has.
pub(crate) fn same_text(a: &str, b: &str) -> bool {
    a.bytes().eq(b.bytes())
}

/// Reason why a contract was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ContractError {
    /// The control period, the temperature or the acceptance threshold is out of its valid range.
    Number,
    /// The number, roles, names or types of the channels are invalid: no observation or more than a
    /// step has room for, no action, more than one action, instruction or noise, too many channels
    /// in all, a name twice, or a role whose elements have the wrong type.
    Channels,
    /// The shape of a channel is invalid, or does not match the number of its elements.
    Shape {
        /// Number of the channel.
        channel: ChannelId,
    },
    /// The limits of a channel are not ordered numbers.
    Limits {
        /// Number of the channel.
        channel: ChannelId,
    },
    /// An instruction has no words, or more than the instruction channel holds.
    Words,
}

impl fmt::Display for ContractError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Number => f.write_str(
                "the control period, the temperature or the acceptance threshold is invalid",
            ),
            Self::Channels => f.write_str(
                "the channels are not observations and one action, each with a name of its own",
            ),
            Self::Shape { channel } => {
                write!(f, "the shape of channel {} is invalid", channel.0)
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
