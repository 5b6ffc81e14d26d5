//! Describes values that a controller refuses, with the names of channel and element.

use lads_core::{ChannelId, Contract, InputError};

/// Describes the error in the values of a channel, as one sentence without a full stop.
pub fn refused(error: &InputError, contract: &Contract<'_>) -> String {
    let Some(channel) = contract.channel(ChannelId(error.channel())) else {
        return error.to_string();
    };
    let name = channel.name();
    let at = |index: usize| {
        let element = channel.elements().nth(index);
        let element = element.map(|element| format!(" `{}`", element.name));
        format!(
            "channel `{name}`, element {index}{}",
            element.unwrap_or_default()
        )
    };
    match *error {
        InputError::Missing { .. } => format!("channel `{name}` is not given"),
        InputError::Unknown { .. } => {
            format!("channel `{name}` is not one to be given here, or is given twice")
        }
        InputError::Type { .. } => format!("channel `{name}` has elements of another type"),
        InputError::Length { got, needed, .. } => {
            format!("channel `{name}` got {got} elements, the contract says {needed}")
        }
        InputError::NotFinite { index, .. } => format!("{} is not finite", at(index)),
        InputError::OutOfLimits {
            index,
            value,
            min,
            max,
            ..
        } => format!("{} is {value}, its limits are {min} to {max}", at(index)),
        _ => error.to_string(),
    }
}
