//! The frame of an image: header, table of sections, checksum.
//!
//! An image is little-endian, starts on a 4-byte boundary (64 is better: weight panels then never
//! straddle cache lines) and is a whole number of 4-byte words. It needs no relocation: it may be
//! in flash, in a mapped file or in a `static`.
//!
//! ```text
//! word 0   MAGIC
//!      1   VERSION
//!      2   total length in bytes
//!      3   CRC-32 of the whole image, taken with this word zero
//!      4   number of sections
//!      5.. zero up to word 8
//!      8.. three words per section: tag, offset, length in bytes; zero up to word 64
//! ```
//!
//! Sections start on a word, do not overlap and follow each other in the order of the table. A reader finds a section by its
//! [`Tag`] and skips tags that it does not know, so that a later version can add one. What the sections hold is described in
//! [`records`](crate::records).
//!
//! [`Layout`] computes offsets, [`Layout::header`] the header and [`crc32`] the checksum, so a
//! writer only fills records. What can fail: [`Sections::new`], on an invalid header or table
//! ([`FormatError`]).

use core::error::Error;
use core::fmt;

use crate::codec::Writer;

/// First word of an image: `LADS` in ASCII.
pub const MAGIC: u32 = u32::from_le_bytes(*b"LADS");

/// Version of the format that this crate describes.
pub const VERSION: u32 = 5;

/// Number of words of the header, the table of sections included.
pub const HEADER_WORDS: usize = 64;

/// Index of the header word that holds the checksum.
pub const CRC_WORD: usize = 3;

/// Index of the header word that holds the number of sections.
pub const COUNT_WORD: usize = 4;

/// Index of the header word that starts the section table.
pub const TABLE_WORD: usize = 8;

/// Largest number of sections that the header has room for.
pub const MAX_SECTIONS: usize = (HEADER_WORDS - TABLE_WORD) / 3;

/// Alignment of the weights inside the image, in bytes.
pub const WEIGHTS_ALIGN: usize = 64;

macro_rules! tags {
    ($($(#[$meta:meta])* $name:ident = $text:literal,)*) => {
        /// Name of a section: four ASCII letters.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[repr(u32)]
        pub enum Tag { $($(#[$meta])* $name = u32::from_le_bytes(*$text),)* }

        impl Tag {
            /// Every tag, in the order in which a writer places the sections.
            pub const ALL: &'static [Self] = &[$(Self::$name,)*];
        }
    };
}

tags! {
    /// Section of the one [`ContractRecord`](crate::records::ContractRecord).
    Contract = b"CONT",
    /// Section of the [`ChannelRecord`](crate::records::ChannelRecord)s.
    Channels = b"CHAN",
    /// Section of the [`ElementRecord`](crate::records::ElementRecord)s, which the channels point
    /// into.
    Elements = b"ELEM",
    /// Section of the [`InstructionRecord`](crate::records::InstructionRecord)s.
    Instructions = b"INST",
    /// Section of texts in UTF-8, zero-padded to a word; [`Text`](crate::records::Text) points into
    /// it.
    Strings = b"STRS",
    /// Section of the [`StateRecord`](crate::records::StateRecord)s.
    States = b"STAT",
    /// Section of the [`EntryRecord`](crate::records::EntryRecord)s.
    Entries = b"ENTR",
    /// Section of the [`PortRecord`](crate::records::PortRecord)s, which the entries point into.
    Ports = b"PORT",
    /// Section of the [`CallRecord`](crate::records::CallRecord)s: the schedule.
    Calls = b"CALL",
    /// Section of the states that calls clear: their indices, one word each.
    Clears = b"CLRS",
    /// Section of the encoded ops, [`OP_WORDS`](crate::OP_WORDS) words each, the entries' ops one
    /// after the other.
    Ops = b"OPS ",
    /// Section of the weights: packed panels in the format that their ops state, biases, tables,
    /// words of the known instructions.
    Weights = b"WGTS",
    /// Section of the recorded episode: empty, or a [`GoldenRecord`](crate::records::GoldenRecord)
    /// and the values that it describes.
    Golden = b"GOLD",
}

/// Number of sections of this version.
pub const SECTIONS: usize = Tag::ALL.len();

/// Location of a section: `offset` and `len` in bytes, both whole words.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SectionSpan {
    /// Offset of the section's first byte.
    pub offset: usize,
    /// Length of the section in bytes.
    pub len: usize,
}

/// Locations of the sections of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    sections: [SectionSpan; SECTIONS],
    total_bytes: usize,
}

impl Layout {
    /// Places sections of these lengths, in bytes, whole words and in the order of [`Tag::ALL`],
    /// one after the other. Returns `None` if a length is not a multiple of 4 or the image would
    /// not fit 32-bit offsets.
    pub fn new(lens: [usize; SECTIONS]) -> Option<Self> {
        let mut sections = [SectionSpan::default(); SECTIONS];
        let mut end = HEADER_WORDS * 4;
        for ((span, len), tag) in sections.iter_mut().zip(lens).zip(Tag::ALL) {
            let align = if matches!(tag, Tag::Weights) {
                WEIGHTS_ALIGN
            } else {
                4
            };
            let offset = end.checked_next_multiple_of(align)?;
            end = offset.checked_add(len)?;
            if len % 4 != 0 {
                return None;
            }
            *span = SectionSpan { offset, len };
        }
        u32::try_from(end).ok()?;
        Some(Self {
            sections,
            total_bytes: end,
        })
    }

    /// Returns the location of a section.
    pub fn section(&self, tag: Tag) -> SectionSpan {
        Tag::ALL
            .iter()
            .zip(self.sections)
            .find(|(known, _)| **known == tag)
            .map_or_else(SectionSpan::default, |(_, span)| span)
    }

    /// Returns the length of the image in bytes.
    pub fn total_bytes(&self) -> usize {
        self.total_bytes
    }

    /// Returns the header with a checksum of zero: write [`crc32`] of the whole image to word
    /// [`CRC_WORD`] last.
    pub fn header(&self) -> [u32; HEADER_WORDS] {
        let mut words = [0; HEADER_WORDS];
        let mut out = Writer::new(&mut words);
        for word in [
            MAGIC,
            VERSION,
            self.total_bytes as u32,
            0,
            SECTIONS as u32,
            0,
            0,
            0,
        ] {
            out.word(word);
        }
        for (tag, span) in Tag::ALL.iter().zip(self.sections) {
            out.word(*tag as u32);
            out.word(span.offset as u32);
            out.word(span.len as u32);
        }
        words
    }
}

/// The sections of an image whose header was checked.
#[derive(Debug, Clone, Copy)]
pub struct Sections<'a> {
    image: &'a [u32],
    table: &'a [[u32; 3]],
}

impl<'a> Sections<'a> {
    /// Checks the table of sections: whole words, inside the image, in order, without overlaps.
    pub fn new(image: &'a [u32]) -> Result<Self, FormatError> {
        let count = image.get(COUNT_WORD).copied().unwrap_or(0) as usize;
        if count > MAX_SECTIONS {
            return Err(FormatError::Table);
        }
        let rows = image
            .get(TABLE_WORD..HEADER_WORDS)
            .ok_or(FormatError::Table)?;
        let table = rows
            .as_chunks::<3>()
            .0
            .get(..count)
            .ok_or(FormatError::Table)?;
        let mut end = HEADER_WORDS;
        for &[_, offset, len] in table {
            let (start, words) = (offset as usize / 4, len as usize / 4);
            let whole = offset.is_multiple_of(4) && len.is_multiple_of(4);
            if !whole || start < end {
                return Err(FormatError::Table);
            }
            end = start.checked_add(words).ok_or(FormatError::Table)?;
            if end > image.len() {
                return Err(FormatError::Table);
            }
        }
        Ok(Self { image, table })
    }

    /// Returns the words of a section; empty when the image has none of this tag.
    pub fn get(&self, tag: Tag) -> &'a [u32] {
        let row = self.table.iter().find(|[found, ..]| *found == tag as u32);
        let Some(&[_, offset, len]) = row else {
            return &[];
        };
        let start = offset as usize / 4;
        self.image
            .get(start..start.saturating_add(len as usize / 4))
            .unwrap_or(&[])
    }
}

/// Reads the image's own length in bytes from its header, whose magic and version are checked.
pub fn total_bytes(image: &[u8]) -> Result<usize, FormatError> {
    let short = FormatError::Truncated {
        got: image.len(),
        needed: HEADER_WORDS * 4,
    };
    let (words, _) = image.get(..HEADER_WORDS * 4).ok_or(short)?.as_chunks::<4>();
    let mut words = words.iter().map(|&bytes| u32::from_le_bytes(bytes));
    if words.next() != Some(MAGIC) {
        return Err(FormatError::Magic);
    }
    match words.next() {
        Some(VERSION) => {}
        version => return Err(FormatError::Version(version.unwrap_or(0))),
    }
    let total = words.next().unwrap_or(0) as usize;
    if total < HEADER_WORDS * 4 || !total.is_multiple_of(4) {
        return Err(FormatError::Length);
    }
    Ok(total)
}

/// Reason why the frame of an image was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum FormatError {
    /// The image ends too early.
    Truncated {
        /// Number of bytes given.
        got: usize,
        /// Number of bytes needed.
        needed: usize,
    },
    /// The first word is not [`MAGIC`]: the bytes are not a program image.
    Magic,
    /// The image has another version than [`VERSION`].
    Version(u32),
    /// The length in the header is invalid.
    Length,
    /// The table of sections is invalid.
    Table,
}

impl fmt::Display for FormatError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Truncated { got, needed } => {
                write!(f, "the program image has {got} bytes, {needed} are needed")
            }
            Self::Magic => f.write_str("not a program image"),
            Self::Version(version) => write!(
                f,
                "program image of version {version}; this runtime reads version {VERSION}"
            ),
            Self::Length => f.write_str("the program image states an invalid length"),
            Self::Table => f.write_str("the section table of the program image is malformed"),
        }
    }
}

impl Error for FormatError {}

/// Checksum contribution of each value of a byte: the reflected polynomial, bit by bit.
const CRC_TABLE: [u32; 256] = {
    let mut table = [0; 256];
    let mut rest: &mut [u32] = &mut table;
    let mut value = 0;
    while let Some((entry, more)) = rest.split_first_mut() {
        let mut crc: u32 = value;
        let mut bit = 0_u32;
        while bit < 8 {
            crc = (crc >> 1) ^ (0xedb8_8320 & (crc & 1).wrapping_neg());
            bit = bit.wrapping_add(1);
        }
        *entry = crc;
        rest = more;
        value = value.wrapping_add(1);
    }
    table
};

/// Computes the CRC-32 (IEEE 802.3, the one of zip and PNG) of an image, its checksum word taken as
/// zero.
#[inline]
pub fn crc32(image: &[u8]) -> u32 {
    let byte_in = |crc: u32, byte: u8| {
        let index = (crc ^ u32::from(byte)) & 0xff;
        (crc >> 8) ^ CRC_TABLE.get(index as usize).copied().unwrap_or(0)
    };
    let (words, rest) = image.as_chunks::<4>();
    let mut crc = u32::MAX;
    for (i, word) in words.iter().enumerate() {
        let word = if i == CRC_WORD { [0; 4] } else { *word };
        crc = word.into_iter().fold(crc, byte_in);
    }
    crc = rest.iter().copied().fold(crc, byte_in);
    !crc
}
