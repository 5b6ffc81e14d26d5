//! Values that a caller gives for the channels of a call, and their checks.
//!
//! Nothing is copied: a program's inputs are filled from the caller's own slices. What can fail: a channel that is missing, given
//! twice, of another type or length, or whose values are not finite or outside the contract's limits ([`InputError`]).

use crate::contract::{Channel, ChannelId, Contract, DType, Interval, Role};
use crate::errors::InputError;

/// Largest number of observation channels of a policy.
pub const MAX_OBSERVATIONS: usize = 8;

/// Values of a channel, as many as it has elements, in the order of its shape.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Data<'d> {
    /// Values of a channel of floats.
    F32(&'d [f32]),
    /// Values of a channel of bytes.
    U8(&'d [u8]),
    /// Values of a channel of integers.
    I32(&'d [i32]),
}

impl Data<'_> {
    /// Returns the number of values.
    pub fn len(&self) -> usize {
        match self {
            Self::F32(values) => values.len(),
            Self::U8(values) => values.len(),
            Self::I32(values) => values.len(),
        }
    }

    /// Returns whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the type of the values.
    pub fn dtype(&self) -> DType {
        match self {
            Self::F32(_) => DType::F32,
            Self::U8(_) => DType::U8,
            Self::I32(_) => DType::I32,
        }
    }
}

/// Values given for the observation channels, in memory of a fixed size.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Given<'d> {
    channels: [(ChannelId, Data<'d>); MAX_OBSERVATIONS],
    len: usize,
}

impl Default for Given<'_> {
    fn default() -> Self {
        Self {
            channels: [(ChannelId(u32::MAX), Data::F32(&[])); MAX_OBSERVATIONS],
            len: 0,
        }
    }
}

impl<'d> Given<'d> {
    /// Adds a channel; one beyond [`MAX_OBSERVATIONS`], which no contract has, is dropped.
    pub fn push(&mut self, channel: ChannelId, data: Data<'d>) {
        if let Some(place) = self.channels.get_mut(self.len) {
            *place = (channel, data);
            self.len = self.len.saturating_add(1);
        }
    }

    pub fn all(&self) -> &[(ChannelId, Data<'d>)] {
        self.channels.get(..self.len).unwrap_or(&[])
    }
}

/// Checks the values given for the channels of a role, each of which has to be there once, and
/// returns the noise if it is given too.
pub(crate) fn check<'d>(
    contract: &Contract,
    role: Role,
    given: &[(ChannelId, Data<'d>)],
    noise_len: usize,
) -> Result<Option<&'d [f32]>, InputError> {
    let mut noise = None;
    for (i, &(id, data)) in given.iter().enumerate() {
        let before = given.get(..i).unwrap_or(&[]);
        let unknown = InputError::Unknown { channel: id.0 };
        let channel = contract.channel(id).ok_or(unknown)?;
        if before.iter().any(|&(other, _)| other == id) {
            return Err(unknown);
        }
        if channel.role() == Role::Noise && role == Role::Observation {
            let Data::F32(draws) = data else {
                return Err(InputError::Type { channel: id.0 });
            };
            length(id, draws.len(), noise_len)?;
            if let Some(index) = draws.iter().position(|x| !x.is_finite()) {
                return Err(InputError::NotFinite {
                    channel: id.0,
                    index,
                });
            }
            noise = Some(draws);
        } else if channel.role() == role {
            check_channel(&channel, data)?;
        } else {
            return Err(unknown);
        }
    }
    let mut needed = contract.channels().filter(|channel| channel.role() == role);
    let missing = needed.find(|channel| !given.iter().any(|&(id, _)| id == channel.id()));
    match missing {
        Some(channel) => Err(InputError::Missing {
            channel: channel.id().0,
        }),
        None => Ok(noise),
    }
}

fn length(channel: ChannelId, got: usize, needed: usize) -> Result<(), InputError> {
    if got == needed {
        return Ok(());
    }
    Err(InputError::Length {
        channel: channel.0,
        got,
        needed,
    })
}

fn check_channel(channel: &Channel, data: Data) -> Result<(), InputError> {
    let id = channel.id();
    length(id, data.len(), channel.len())?;
    match data {
        _ if data.dtype() != channel.dtype() => Err(InputError::Type { channel: id.0 }),
        Data::F32(values) => check_floats(id, values, channel.limits()),
        // A camera gives a hundred thousand of them in every control step.
        Data::U8(_) if channel.takes_every_byte() => Ok(()),
        Data::U8(values) => check_floats(id, values, channel.limits()),
        Data::I32(values) => check_integers(id, values, channel.limits()),
    }
}

/// Checks that every value is finite and inside its limits.
#[inline]
pub(crate) fn check_floats<T: Copy + Into<f32>>(
    channel: ChannelId,
    values: &[T],
    limits: impl Iterator<Item = Interval>,
) -> Result<(), InputError> {
    let channel = channel.0;
    for (index, (&value, Interval { min, max })) in values.iter().zip(limits).enumerate() {
        let value: f32 = value.into();
        if !value.is_finite() {
            return Err(InputError::NotFinite { channel, index });
        }
        if value < min || value > max {
            return Err(InputError::OutOfLimits {
                channel,
                index,
                value,
                min,
                max,
            });
        }
    }
    Ok(())
}

/// Checks that every value is inside its limits, compared exactly.
fn check_integers(
    channel: ChannelId,
    values: &[i32],
    limits: impl Iterator<Item = Interval>,
) -> Result<(), InputError> {
    for (index, (&value, Interval { min, max })) in values.iter().zip(limits).enumerate() {
        let exact = f64::from(value);
        if exact < f64::from(min) || exact > f64::from(max) {
            return Err(InputError::OutOfLimits {
                channel: channel.0,
                index,
                value: value as f32,
                min,
                max,
            });
        }
    }
    Ok(())
}
