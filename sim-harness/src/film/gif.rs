//! Writes an animated GIF with one palette, made from sample pictures; each picture holds only what changed, so that minutes of a resting
//! camera stay small. What can fail: no room.

use std::io::BufWriter;
use std::path::Path;

use color_quant::NeuQuant;
use gif::{DisposalMethod, Encoder, Frame, Repeat};

use super::FilmError;
use super::canvas::Canvas;
use super::caption;
use crate::output::{self, Draft};

/// Entries of the palette. The last means "unchanged"; captions have the ones before it.
const ENTRIES: usize = 256;
const UNCHANGED: u8 = 255;
/// Bits of each colour channel that the search for the nearest palette entry uses.
const CHANNEL_BITS: u32 = 6;

/// An animated GIF that is being written.
pub(super) struct Gif {
    /// The file; taken by the encoder at the first picture.
    file: Option<Draft>,
    encoder: Option<Encoder<BufWriter<Draft>>>,
    /// Pixels of sample pictures, four bytes each.
    sample: Vec<u8>,
    quantiser: Option<NeuQuant>,
    /// Nearest palette entry by colour, each sought when it is first seen.
    nearest: Vec<Option<u8>>,
    /// The picture that is shown at present.
    shown: Vec<u8>,
}

impl Gif {
    pub(super) fn new(path: &Path) -> Result<Self, FilmError> {
        Ok(Self {
            file: Some(output::draft(path)?),
            encoder: None,
            sample: Vec::new(),
            quantiser: None,
            nearest: vec![None; 1 << (3 * CHANNEL_BITS)],
            shown: Vec::new(),
        })
    }

    pub(super) fn learn(&mut self, canvas: &Canvas) {
        let pixels = canvas.rgb().chunks_exact(3);
        let opaque = pixels.flat_map(|pixel| [pixel[0], pixel[1], pixel[2], u8::MAX]);
        self.sample.extend(opaque);
    }

    /// Starts the file, with a palette of the sample's and the captions' colours.
    fn begin(&mut self, file: Draft, size: [u16; 2]) -> Result<(), FilmError> {
        let captions: Vec<[u8; 3]> = caption::colors().collect();
        let colors = ENTRIES - 1 - captions.len();
        let quantiser = NeuQuant::new(10, colors, &self.sample);
        self.sample = Vec::new();
        let mut palette = quantiser.color_map_rgb();
        for (entry, color) in (colors..).zip(captions) {
            palette.extend(color);
            if let Some(nearest) = self.nearest.get_mut(place(color)) {
                *nearest = Some(entry as u8);
            }
        }
        palette.resize(3 * ENTRIES, 0);
        let [width, height] = size;
        let mut encoder =
            Encoder::new(BufWriter::new(file), width, height, &palette).map_err(gif_error)?;
        encoder.set_repeat(Repeat::Infinite).map_err(gif_error)?;
        (self.encoder, self.quantiser) = (Some(encoder), Some(quantiser));
        Ok(())
    }

    pub(super) fn add(&mut self, canvas: &Canvas, seconds: f64) -> Result<(), FilmError> {
        let [width, height] = canvas.size().map(|pixels| pixels as u16);
        if let Some(file) = self.file.take() {
            if self.sample.is_empty() {
                self.learn(canvas);
            }
            self.begin(file, [width, height])?;
        }
        let pixels = canvas.rgb().chunks_exact(3);
        let pixels: Vec<u8> = pixels
            .map(|pixel| self.index([pixel[0], pixel[1], pixel[2]]))
            .collect();
        let before = self.shown.iter().map(Some).chain(std::iter::repeat(None));
        let changed: Vec<u8> = pixels
            .iter()
            .zip(before)
            .map(|(now, before)| if before == Some(now) { UNCHANGED } else { *now })
            .collect();
        self.shown = pixels;
        let frame = Frame {
            width,
            height,
            delay: (100.0 * seconds).round() as u16,
            dispose: DisposalMethod::Keep,
            transparent: Some(UNCHANGED),
            buffer: changed.into(),
            ..Frame::default()
        };
        match &mut self.encoder {
            Some(encoder) => encoder.write_frame(&frame).map_err(gif_error),
            None => Ok(()),
        }
    }

    /// Index of the palette entry nearest to a colour.
    fn index(&mut self, color: [u8; 3]) -> u8 {
        let (quantiser, [r, g, b]) = (&self.quantiser, color);
        let nearest = || {
            let quantiser = quantiser.as_ref();
            quantiser.map_or(0, |known| known.index_of(&[r, g, b, u8::MAX]) as u8)
        };
        let entry = self.nearest.get_mut(place(color));
        entry.map_or(0, |entry| *entry.get_or_insert_with(nearest))
    }

    pub(super) fn finish(self) -> Result<Draft, FilmError> {
        let Some(encoder) = self.encoder else {
            return Err(FilmError::Draw("there is no picture".to_owned()));
        };
        let buffered = encoder.into_inner().map_err(gif_error)?;
        buffered
            .into_inner()
            .map_err(|error| FilmError::Write(error.into_error()))
    }
}

/// Index in `nearest` of a colour's nearest palette entry.
fn place(color: [u8; 3]) -> usize {
    color.iter().fold(0, |place, &channel| {
        (place << CHANNEL_BITS) | (channel >> (8 - CHANNEL_BITS)) as usize
    })
}

fn gif_error(error: gif::EncodingError) -> FilmError {
    match error {
        gif::EncodingError::Io(error) => FilmError::Write(error),
        error => FilmError::Draw(error.to_string()),
    }
}
