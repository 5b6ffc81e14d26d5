//! Tables of an image: every section as records of its kind.
//!
//! Invariant of [`Tables`]: the frame is sound, every record decodes, every text lies inside the
//! strings, and every range that a record holds lies inside its section. The core checks whether
//! the records form a valid policy. What can fail: [`Tables::new`] ([`TablesError`]); afterwards an
//! accessor returns `None` only for an index past the end.

use core::error::Error;
use core::fmt;

use crate::codec::{Field, Reader};
use crate::format::{self, CRC_WORD, FormatError, Sections, Tag};
use crate::place::WeightSpan;
use crate::records::{
    CallRecord, ChannelRecord, ContractRecord, ElementRecord, EntryRecord, InstructionRecord,
    PortRecord, StateRecord, Text,
};
use crate::{OP_WORDS, Op};

/// The sections of one image.
#[derive(Debug, Clone, Copy)]
pub struct Tables<'a> {
    image: &'a [u8],
    contract: &'a [u32],
    channels: &'a [[u32; ChannelRecord::WORDS]],
    elements: &'a [[u32; ElementRecord::WORDS]],
    instructions: &'a [[u32; InstructionRecord::WORDS]],
    strings: &'a str,
    states: &'a [[u32; StateRecord::WORDS]],
    entries: &'a [[u32; EntryRecord::WORDS]],
    ports: &'a [[u32; PortRecord::WORDS]],
    calls: &'a [[u32; CallRecord::WORDS]],
    clears: &'a [u32],
    ops: &'a [[u32; OP_WORDS]],
    weights: &'a [f32],
    golden: &'a [u32],
}

/// Splits the words of a section into records of `N` words.
fn rows<const N: usize>(words: &[u32], tag: Tag) -> Result<&[[u32; N]], TablesError> {
    let (rows, rest) = words.as_chunks::<N>();
    if rest.is_empty() {
        Ok(rows)
    } else {
        Err(TablesError::Section(tag))
    }
}

/// Decodes one record of a table.
#[inline]
fn take<T: Field, const N: usize>(rows: &[[u32; N]], index: usize) -> Option<T> {
    rows.get(index)
        .and_then(|row| T::take(&mut Reader::new(row)))
}

/// Decodes every record of a table; `None` for one that does not decode.
fn all<T: Field, const N: usize>(rows: &[[u32; N]]) -> impl Iterator<Item = Option<T>> + '_ {
    rows.iter().map(|row| T::take(&mut Reader::new(row)))
}

/// Returns `first..first + len` of `table`; empty for a range outside, which checked tables do not
/// have.
fn part<T>(table: &[T], first: u32, len: u32) -> &[T] {
    let start = first as usize;
    table
        .get(start..start.saturating_add(len as usize))
        .unwrap_or(&[])
}

fn inside(first: u32, len: u32, count: usize) -> bool {
    u64::from(first).saturating_add(u64::from(len)) <= count as u64
}

impl<'a> Tables<'a> {
    /// Opens an image that starts on a 4-byte boundary; bytes after the image's own length are ignored.
    #[inline(never)]
    pub fn new(image: &'a [u8]) -> Result<Self, TablesError> {
        if cfg!(target_endian = "big") {
            return Err(TablesError::BigEndian);
        }
        let total = format::total_bytes(image).map_err(TablesError::Format)?;
        let got = image.len();
        let image = image
            .get(..total)
            .ok_or(TablesError::Format(FormatError::Truncated {
                got,
                needed: total,
            }))?;
        let words: &[u32] = bytemuck::try_cast_slice(image).map_err(|_| TablesError::Alignment)?;
        let sections = Sections::new(words).map_err(TablesError::Format)?;
        let strings = bytemuck::try_cast_slice(sections.get(Tag::Strings))
            .ok()
            .and_then(|bytes| core::str::from_utf8(bytes).ok())
            .ok_or(TablesError::Section(Tag::Strings))?;
        let weights = bytemuck::try_cast_slice(sections.get(Tag::Weights))
            .map_err(|_| TablesError::Section(Tag::Weights))?;
        let tables = Self {
            image,
            contract: sections.get(Tag::Contract),
            channels: rows(sections.get(Tag::Channels), Tag::Channels)?,
            elements: rows(sections.get(Tag::Elements), Tag::Elements)?,
            instructions: rows(sections.get(Tag::Instructions), Tag::Instructions)?,
            strings,
            states: rows(sections.get(Tag::States), Tag::States)?,
            entries: rows(sections.get(Tag::Entries), Tag::Entries)?,
            ports: rows(sections.get(Tag::Ports), Tag::Ports)?,
            calls: rows(sections.get(Tag::Calls), Tag::Calls)?,
            clears: sections.get(Tag::Clears),
            ops: rows(sections.get(Tag::Ops), Tag::Ops)?,
            weights,
            golden: sections.get(Tag::Golden),
        };
        tables.check()?;
        Ok(tables)
    }

    #[inline(never)]
    fn check(&self) -> Result<(), TablesError> {
        let at = |tag, fits: bool| {
            if fits {
                Ok(())
            } else {
                Err(TablesError::Record(tag))
            }
        };
        let texts = |texts: &[Text]| texts.iter().all(|&text| self.find(text).is_some());
        let contract = self.contract();
        at(
            Tag::Contract,
            self.contract.len() == ContractRecord::WORDS
                && contract.is_some_and(|c| {
                    texts(&[
                        c.family,
                        c.environment_id,
                        c.environment_version,
                        c.encoder,
                        c.encoder_sha256,
                        c.bundle_sha256,
                    ])
                }),
        )?;
        at(
            Tag::Channels,
            all(self.channels).all(|channel: Option<ChannelRecord>| {
                channel.is_some_and(|c| {
                    texts(&[c.name, c.reference])
                        && inside(c.first_element, c.elements_len, self.elements.len())
                })
            }),
        )?;
        at(
            Tag::Elements,
            all(self.elements).all(|element: Option<ElementRecord>| {
                element.is_some_and(|e| {
                    texts(&[e.name, e.unit, e.joint, e.interface, e.physical_unit])
                })
            }),
        )?;
        at(
            Tag::Instructions,
            all(self.instructions).all(|known: Option<InstructionRecord>| {
                known.is_some_and(|known| {
                    texts(&[known.id, known.text])
                        && inside(known.words.offset, known.words.len, self.weights.len())
                })
            }),
        )?;
        at(
            Tag::States,
            all(self.states)
                .all(|state: Option<StateRecord>| state.is_some_and(|state| texts(&[state.name]))),
        )?;
        at(
            Tag::Entries,
            all(self.entries).all(|entry: Option<EntryRecord>| {
                entry.is_some_and(|e| {
                    texts(&[e.name])
                        && inside(e.first_op, e.ops_len, self.ops.len())
                        && inside(e.first_input, e.inputs_len, self.ports.len())
                        && inside(e.first_output, e.outputs_len, self.ports.len())
                })
            }),
        )?;
        at(
            Tag::Ports,
            all(self.ports)
                .all(|port: Option<PortRecord>| port.is_some_and(|port| texts(&[port.name]))),
        )?;
        at(
            Tag::Calls,
            all(self.calls).all(|call: Option<CallRecord>| {
                call.is_some_and(|call| {
                    inside(call.first_clear, call.clears_len, self.clears.len())
                })
            }),
        )
    }

    /// Returns the image, without the bytes after it.
    pub fn image(&self) -> &'a [u8] {
        self.image
    }

    /// Reads the whole image and returns true if no bit has changed since it was written.
    #[inline]
    pub fn checksum_matches(&self) -> bool {
        let stored = self.image.as_chunks::<4>().0.get(CRC_WORD);
        stored.map(|&bytes| u32::from_le_bytes(bytes)) == Some(format::crc32(self.image))
    }

    /// Returns the fixed part of the contract.
    pub fn contract(&self) -> Option<ContractRecord> {
        ContractRecord::take(&mut Reader::new(self.contract))
    }

    /// Returns the number of channels.
    pub fn channels_len(&self) -> usize {
        self.channels.len()
    }

    /// Returns channel `i`.
    #[inline]
    pub fn channel(&self, i: usize) -> Option<ChannelRecord> {
        take(self.channels, i)
    }

    /// Returns the records of a channel's elements.
    #[inline]
    pub fn elements(&self, channel: &ChannelRecord) -> &'a [[u32; ElementRecord::WORDS]] {
        part(self.elements, channel.first_element, channel.elements_len)
    }

    /// Returns the number of element records of all channels.
    pub fn elements_len(&self) -> usize {
        self.elements.len()
    }

    /// Returns the number of known instructions.
    pub fn instructions_len(&self) -> usize {
        self.instructions.len()
    }

    /// Returns known instruction `i`.
    pub fn instruction(&self, i: usize) -> Option<InstructionRecord> {
        take(self.instructions, i)
    }

    /// Returns the number of states.
    pub fn states_len(&self) -> usize {
        self.states.len()
    }

    /// Returns state `i`.
    #[inline]
    pub fn state(&self, i: usize) -> Option<StateRecord> {
        take(self.states, i)
    }

    /// Returns the number of entries.
    pub fn entries_len(&self) -> usize {
        self.entries.len()
    }

    /// Returns entry `i`.
    #[inline]
    pub fn entry(&self, i: usize) -> Option<EntryRecord> {
        take(self.entries, i)
    }

    /// Returns the inputs of an entry.
    #[inline]
    pub fn inputs(&self, entry: &EntryRecord) -> impl Iterator<Item = PortRecord> + use<'a> {
        ports(part(self.ports, entry.first_input, entry.inputs_len))
    }

    /// Returns the outputs of an entry.
    #[inline]
    pub fn outputs(&self, entry: &EntryRecord) -> impl Iterator<Item = PortRecord> + use<'a> {
        ports(part(self.ports, entry.first_output, entry.outputs_len))
    }

    /// Returns the number of ports of all entries.
    pub fn ports_len(&self) -> usize {
        self.ports.len()
    }

    /// Returns the ops of an entry.
    #[inline]
    pub fn ops(&self, entry: &EntryRecord) -> &'a [[u32; OP_WORDS]] {
        part(self.ops, entry.first_op, entry.ops_len)
    }

    /// Decodes the ops of all entries.
    pub fn every_op(&self) -> impl Iterator<Item = Op> + use<'_, 'a> {
        let entries = (0..self.entries_len()).filter_map(|i| self.entry(i));
        entries
            .flat_map(|entry| self.ops(&entry))
            .filter_map(Op::decode)
    }

    /// Returns the number of ops of all entries.
    pub fn ops_len(&self) -> usize {
        self.ops.len()
    }

    /// Returns the number of calls of the schedule.
    pub fn calls_len(&self) -> usize {
        self.calls.len()
    }

    /// Returns the calls of the schedule, in order.
    #[inline]
    pub fn calls(&self) -> impl Iterator<Item = CallRecord> + use<'a> {
        self.calls
            .iter()
            .filter_map(|row| CallRecord::take(&mut Reader::new(row)))
    }

    /// Returns the states that a call clears.
    #[inline]
    pub fn clears(&self, call: &CallRecord) -> &'a [u32] {
        part(self.clears, call.first_clear, call.clears_len)
    }

    /// Returns the number of states that all calls clear.
    pub fn clears_len(&self) -> usize {
        self.clears.len()
    }

    /// Returns all weights.
    #[inline]
    pub fn weights(&self) -> &'a [f32] {
        self.weights
    }

    /// Returns a part of the weights; empty for a span outside.
    pub fn span(&self, span: WeightSpan) -> &'a [f32] {
        part(self.weights, span.offset, span.len)
    }

    /// Returns the words of the golden section.
    pub fn golden(&self) -> &'a [u32] {
        self.golden
    }

    /// Returns a text; empty for one outside the strings.
    pub fn text(&self, text: Text) -> &'a str {
        self.find(text).unwrap_or("")
    }

    fn find(&self, text: Text) -> Option<&'a str> {
        let start = text.offset as usize;
        self.strings
            .get(start..start.checked_add(text.len as usize)?)
    }
}

#[inline]
fn ports(rows: &[[u32; PortRecord::WORDS]]) -> impl Iterator<Item = PortRecord> + '_ {
    rows.iter()
        .filter_map(|row| PortRecord::take(&mut Reader::new(row)))
}

/// Reason why the tables of an image were refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum TablesError {
    /// This processor is big-endian; images are little-endian.
    BigEndian,
    /// The image does not start on a 4-byte boundary.
    Alignment,
    /// The frame of the image is invalid.
    Format(FormatError),
    /// A section is not a multiple of the size of its records, or text that is not UTF-8.
    Section(Tag),
    /// A record of the section does not decode, or points outside the image.
    Record(Tag),
}

impl fmt::Display for TablesError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::BigEndian => {
                f.write_str("program images are little-endian and this processor is not")
            }
            Self::Alignment => f.write_str("the program image does not start on a 4-byte boundary"),
            Self::Format(error) => error.fmt(f),
            Self::Section(tag) => write!(f, "section {tag:?} of the program image is malformed"),
            Self::Record(tag) => write!(
                f,
                "a record in section {tag:?} of the program image is malformed"
            ),
        }
    }
}

impl Error for TablesError {}
