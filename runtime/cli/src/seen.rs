//! Observation of one control step, as a line of numbers and as values of channels.
//!
//! Invariant: there are as many values as the observation channels have elements, one channel after
//! the other. What can fail: an invalid line, or a number that is not a value of its channel's
//! type; the message names channel and element.

use lads_core::{Channel, ChannelId, Contract, DType, Data};

use crate::line::{self, Form, LineError};

/// The observation channels of a policy and their values.
pub struct Seen {
    channels: Vec<Values>,
    /// All values in the order in which they were read.
    numbers: Vec<f32>,
}

/// The values of one channel.
struct Values {
    id: ChannelId,
    name: String,
    /// Rows and columns of an image.
    size: [u32; 2],
    /// Names of the elements; empty for images and the like.
    elements: Vec<String>,
    held: Held,
    /// True if the channel's values are not part of a line.
    beside: bool,
}

enum Held {
    F32(Vec<f32>),
    U8(Vec<u8>),
    I32(Vec<i32>),
}

impl Seen {
    /// Makes zeros for the observation channels of a policy, of which those in `beside` are not part
    /// of a line.
    pub fn of(contract: &Contract, beside: &[ChannelId]) -> Self {
        let channels: Vec<Values> = contract
            .observations()
            .map(|channel| Values::of(&channel, beside.contains(&channel.id())))
            .collect();
        let in_lines = channels.iter().filter(|values| !values.beside);
        let numbers = vec![0.0; in_lines.map(|values| values.held.len()).sum()];
        Self { channels, numbers }
    }

    /// Returns the bytes of a channel; empty for a channel of other elements.
    pub fn bytes(&mut self, id: ChannelId) -> &mut [u8] {
        let found = self.channels.iter_mut().find(|values| values.id == id);
        match found.map(|values| &mut values.held) {
            Some(Held::U8(bytes)) => bytes,
            _ => &mut [],
        }
    }

    /// Returns the number of elements of a line.
    pub fn len(&self) -> usize {
        self.numbers.len()
    }

    /// Reads the values of a line.
    pub fn read(&mut self, text: &str) -> Result<Form, String> {
        let form = line::parse(text, &mut self.numbers).map_err(|error| match error {
            LineError::NotANumber { position, .. } | LineError::NotFinite { position, .. } => {
                format!("{error} ({})", self.at(position - 1))
            }
            other => other.to_string(),
        })?;
        let mut rest = &self.numbers[..];
        let mut place = 0;
        for values in self.channels.iter_mut().filter(|values| !values.beside) {
            let (own, behind) = rest.split_at(values.held.len());
            rest = behind;
            if let Err(element) = values.held.take(own) {
                let (value, dtype) = (own[element], values.held.dtype());
                place += element;
                let at = self.at(place);
                return Err(format!("value {} is {value}, no {dtype} ({at})", place + 1));
            }
            place += own.len();
        }
        Ok(form)
    }

    /// Returns the values, channel by channel.
    pub fn given(&self) -> Vec<(ChannelId, Data<'_>)> {
        fn data(held: &Held) -> Data<'_> {
            match held {
                Held::F32(values) => Data::F32(values),
                Held::U8(values) => Data::U8(values),
                Held::I32(values) => Data::I32(values),
            }
        }
        let all = self.channels.iter();
        all.map(|values| (values.id, data(&values.held))).collect()
    }

    /// Returns the values of all channels but those of bytes, in the contract's order.
    pub fn numbers(&self) -> Vec<f32> {
        let all = self.channels.iter().flat_map(|values| match &values.held {
            Held::F32(values) => values.clone(),
            Held::I32(values) => values.iter().map(|&value| value as f32).collect(),
            Held::U8(_) => vec![],
        });
        all.collect()
    }

    /// Returns name, rows and columns, and the frame of each channel of pixels.
    pub fn cameras(&self) -> impl Iterator<Item = (&str, [u32; 2], &[u8])> {
        self.channels
            .iter()
            .filter_map(|values| match &values.held {
                Held::U8(bytes) => Some((values.name.as_str(), values.size, &bytes[..])),
                _ => None,
            })
    }

    /// Names channel and element of the value at a position.
    fn at(&self, mut place: usize) -> String {
        for values in self.channels.iter().filter(|values| !values.beside) {
            if place < values.held.len() {
                return values.element(place);
            }
            place -= values.held.len();
        }
        String::new()
    }
}

impl Values {
    fn of(channel: &Channel<'_>, beside: bool) -> Self {
        let len = channel.len();
        Self {
            id: channel.id(),
            beside,
            name: channel.name().to_owned(),
            size: match *channel.shape() {
                [rows, columns, _] => [rows, columns],
                _ => [0; 2],
            },
            elements: (channel.elements())
                .map(|element| element.name.to_owned())
                .collect(),
            held: match channel.dtype() {
                DType::F32 => Held::F32(vec![0.0; len]),
                DType::U8 => Held::U8(vec![0; len]),
                DType::I32 => Held::I32(vec![0; len]),
            },
        }
    }

    /// Names element `i`.
    fn element(&self, i: usize) -> String {
        let name = self.elements.get(i).map(|name| format!(" `{name}`"));
        let name = name.unwrap_or_default();
        format!("channel `{}`, element {i}{name}", self.name)
    }
}

impl Held {
    fn len(&self) -> usize {
        match self {
            Self::F32(values) => values.len(),
            Self::U8(values) => values.len(),
            Self::I32(values) => values.len(),
        }
    }

    fn dtype(&self) -> &'static str {
        match self {
            Self::F32(_) => "number",
            Self::U8(_) => "byte",
            Self::I32(_) => "integer of 32 bits",
        }
    }

    /// Copies values; an error is the index of the first that is not of the channel's type.
    fn take(&mut self, from: &[f32]) -> Result<(), usize> {
        let whole = |value: f32, min: f64, max: f64| {
            value.fract() == 0.0 && (min..=max).contains(&f64::from(value))
        };
        for (i, &value) in from.iter().enumerate() {
            match self {
                Self::F32(values) => values[i] = value,
                Self::U8(values) => {
                    if !whole(value, 0.0, 255.0) {
                        return Err(i);
                    }
                    values[i] = value as u8;
                }
                Self::I32(values) => {
                    if !whole(value, i32::MIN.into(), i32::MAX.into()) {
                        return Err(i);
                    }
                    values[i] = value as i32;
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channel(id: u32, name: &str, elements: &[&str], held: Held) -> Values {
        Values {
            id: ChannelId(id),
            name: name.into(),
            size: [0; 2],
            elements: elements.iter().map(ToString::to_string).collect(),
            held,
            beside: false,
        }
    }

    fn seen() -> Seen {
        Seen {
            channels: vec![
                channel(0, "joints", &["hip", "knee"], Held::F32(vec![0.0; 2])),
                channel(2, "camera", &[], Held::U8(vec![0; 2])),
                channel(3, "mode", &[], Held::I32(vec![0])),
            ],
            numbers: vec![0.0; 5],
        }
    }

    #[test]
    fn a_line_is_split_among_the_channels() {
        let mut seen = seen();
        assert_eq!(seen.read("0.5,-1,255,0,-7"), Ok(Form::Csv));
        let given = seen.given();
        assert_eq!(given[0], (ChannelId(0), Data::F32(&[0.5, -1.0])));
        assert_eq!(given[1], (ChannelId(2), Data::U8(&[255, 0])));
        assert_eq!(given[2], (ChannelId(3), Data::I32(&[-7])));
    }

    #[test]
    fn mistakes_name_channel_and_element() {
        let mut seen = seen();
        let mut error = |line| seen.read(line).unwrap_err();
        assert_eq!(
            error("0,nan,0,0,0"),
            "value 2 is 'nan', not finite (channel `joints`, element 1 `knee`)"
        );
        assert_eq!(
            error("0,0,0,256,0"),
            "value 4 is 256, no byte (channel `camera`, element 1)"
        );
        assert_eq!(
            error("0,0,0,0,0.5"),
            "value 5 is 0.5, no integer of 32 bits (channel `mode`, element 0)"
        );
    }
}
