//! Channels: the inputs and outputs of a policy, with the names, units and limits of their
//! elements.

use lads_image::codec::{Field, Reader};
use lads_image::records::{self, ChannelRecord, ElementRecord};
use lads_image::tables::Tables;

use super::{ContractError, same_text};
use crate::errors::InputError;
use crate::inputs;

/// Largest number of elements that a channel may have: an image of 4,096 by 4,096 pixels of four
/// colours is within it.
const MAX_CHANNEL_LEN: u64 = 1 << 26;

/// Number of a channel of a policy: its position among
/// [`Contract::channels`](super::Contract::channels).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ChannelId(pub u32);

/// Purpose of a channel.
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

/// Type of a channel's elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DType {
    /// Elements of 32-bit floats.
    F32,
    /// Elements of bytes, such as the pixels of a camera.
    U8,
    /// Elements of signed 32-bit integers.
    I32,
}

/// Order of the components of the quaternions in a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum QuaternionOrder {
    /// The channel has no quaternions.
    None,
    /// Quaternions with the scalar first.
    Wxyz,
    /// Quaternions with the scalar last.
    Xyzw,
}

/// One channel: an input or output of the policy.
#[derive(Debug, Clone, Copy)]
pub struct Channel<'a> {
    tables: Tables<'a>,
    pub(super) record: ChannelRecord,
    id: ChannelId,
}

/// One element of a channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Element<'a> {
    /// Name of the element.
    pub name: &'a str,
    /// Unit of the element; `1` for a dimensionless one.
    pub unit: &'a str,
    /// Joint that the element belongs to; empty for none.
    pub joint: &'a str,
    /// Quantity of the joint: `position`, `velocity`, `effort`; empty where the bundle does not
    /// say.
    pub interface: &'a str,
    /// Unit of the physical value that the element stands for; empty where the bundle does not say.
    pub physical_unit: &'a str,
    /// Physical value of one unit of the element: physical = reference + offset + scale * value.
    pub scale: f32,
    /// Physical value for an element of zero, without the channel's reference.
    pub offset: f32,
    /// Limits that the contract sets.
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
    /// Returns the value, or the nearest limit if it lies outside. NaN stays NaN.
    #[inline]
    pub fn clamp(self, value: f32) -> f32 {
        // `f32::clamp` without its panic on limits in the wrong order, which a checked contract does not have; two selections and
        // no branch, so that a control step takes the same instructions whatever the action.
        let raised = if value < self.min { self.min } else { value };
        if raised > self.max { self.max } else { raised }
    }
}

/// The limits of a channel's elements: one record each, or one interval for all.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bounds<'a> {
    own: &'a [[u32; ElementRecord::WORDS]],
    alike: Interval,
    pub(super) len: usize,
}

/// Returns the limits in an element's record: its last two words.
fn interval(&[.., min, max]: &[u32; ElementRecord::WORDS]) -> Interval {
    Interval {
        min: f32::from_bits(min),
        max: f32::from_bits(max),
    }
}

impl<'a> Bounds<'a> {
    pub(super) const NONE: Self = Self {
        own: &[],
        alike: Interval { min: 0.0, max: 0.0 },
        len: 0,
    };

    pub(super) fn iter(self) -> impl Iterator<Item = Interval> + use<'a> {
        let rest = self.len.saturating_sub(self.own.len());
        self.own
            .iter()
            .map(interval)
            .chain(core::iter::repeat_n(self.alike, rest))
    }

    /// Moves every value inside its limits.
    #[inline]
    pub fn clamp(self, values: &mut [f32]) {
        if self.own.is_empty() {
            for value in values {
                *value = self.alike.clamp(*value);
            }
        } else {
            for (value, limits) in values.iter_mut().zip(self.own.iter().map(interval)) {
                *value = limits.clamp(*value);
            }
        }
    }

    /// Checks that there are as many values as elements, each finite and inside its limits.
    #[inline]
    pub fn check(self, channel: ChannelId, values: &[f32]) -> Result<(), InputError> {
        let (got, needed) = (values.len(), self.len);
        if got != needed {
            return Err(InputError::Length {
                channel: channel.0,
                got,
                needed,
            });
        }
        if self.own.is_empty() {
            inputs::check_floats(channel, values, core::iter::repeat(self.alike))
        } else {
            inputs::check_floats(channel, values, self.own.iter().map(interval))
        }
    }
}

/// Placeholder for a missing channel, which no checked contract asks for.
pub(super) const EMPTY: ChannelRecord = ChannelRecord {
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
    /// Returns whether another element has the same meaning and the same limits.
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
    pub(super) fn new(tables: Tables<'a>, record: ChannelRecord, id: ChannelId) -> Self {
        Self { tables, record, id }
    }

    /// Returns whether another channel has the same meaning to those who give observations and
    /// execute actions.
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

    /// Checks the channel's record; `elements` is the number of element records of the channels
    /// before this one.
    pub(super) fn check(&self, elements: u32) -> Result<(), ContractError> {
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

    /// Returns the number of the channel.
    pub fn id(&self) -> ChannelId {
        self.id
    }

    /// Returns the name of the channel.
    pub fn name(&self) -> &'a str {
        self.tables.text(self.record.name)
    }

    /// Returns the purpose of the channel.
    pub fn role(&self) -> Role {
        match self.record.role {
            records::Role::Observation => Role::Observation,
            records::Role::Action => Role::Action,
            records::Role::Instruction => Role::Instruction,
            records::Role::Noise => Role::Noise,
            records::Role::Demonstration => Role::Demonstration,
        }
    }

    /// Returns the type of the channel's elements.
    pub fn dtype(&self) -> DType {
        match self.record.dtype {
            records::DType::F32 => DType::F32,
            records::DType::U8 => DType::U8,
            records::DType::I32 => DType::I32,
        }
    }

    /// Returns the lengths of the channel's axes, one to four.
    pub fn shape(&self) -> &[u32] {
        let rank = self.record.rank as usize;
        self.record.dims.get(..rank).unwrap_or(&self.record.dims)
    }

    /// Returns the number of elements of the channel.
    #[inline]
    #[expect(
        clippy::len_without_is_empty,
        reason = "a channel has an element at least"
    )]
    pub fn len(&self) -> usize {
        let [a, b, c, d] = self.record.dims.map(|dim| dim as usize);
        a.saturating_mul(b).saturating_mul(c).saturating_mul(d)
    }

    /// Returns the order of the components of the channel's quaternions.
    pub fn quaternion_order(&self) -> QuaternionOrder {
        match self.record.quaternions {
            records::QuaternionOrder::None => QuaternionOrder::None,
            records::QuaternionOrder::Wxyz => QuaternionOrder::Wxyz,
            records::QuaternionOrder::Xyzw => QuaternionOrder::Xyzw,
        }
    }

    /// Returns the description of the reference that the values are relative to; empty where the
    /// bundle does not say.
    pub fn reference(&self) -> &'a str {
        self.tables.text(self.record.reference)
    }

    /// Returns the channel's elements with names and units; none for images and the like, whose
    /// [`limits`](Self::limits) are alike.
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

    /// Returns element `i` of the channel.
    pub fn element(&self, i: usize) -> Option<Element<'a>> {
        self.elements().nth(i)
    }

    /// Returns the limits of the channel's elements. It reads no text, so a control step uses it.
    #[inline]
    pub fn limits(&self) -> impl Iterator<Item = Interval> + use<'a> {
        self.bounds().iter()
    }

    /// Returns whether the limits admit every byte.
    #[inline]
    pub(crate) fn takes_every_byte(&self) -> bool {
        let bounds = self.bounds();
        bounds.own.is_empty() && bounds.alike.min <= 0.0 && bounds.alike.max >= 255.0
    }

    pub(super) fn bounds(&self) -> Bounds<'a> {
        Bounds {
            own: self.tables.elements(&self.record),
            alike: Interval {
                min: self.record.min,
                max: self.record.max,
            },
            len: self.len(),
        }
    }
}
