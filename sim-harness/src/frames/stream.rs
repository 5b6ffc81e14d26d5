//! Frames of states that come one after the other, for a program that drives a simulator of its own: `lads-run frames --stream`.
//!
//! One line of JSON ([`Heading`]), then for each state of `positions` numbers (f64, little endian) on the input the bytes of its frame on the
//! output, at once. It ends with the input. What can fail: an input that ends within a state, a reader that went away, no EGL.

use std::collections::BTreeMap;
use std::io::{self, Read, Write};

use serde::Serialize;
use thiserror::Error;

use super::{Frames, Rendering};
use crate::film::FilmError;

/// Why a stream of frames ended early.
#[derive(Debug, Error)]
pub enum StreamError {
    /// The input ends in the middle of a state.
    #[error("the input ends within a state: {read} of its {wanted} bytes; write whole states")]
    Cut {
        /// Bytes that came.
        read: usize,
        /// Bytes of a state.
        wanted: usize,
    },
    /// A pipe broke.
    #[error("the stream broke: {0}; read every frame before the next state is written")]
    Io(#[from] io::Error),
    /// A frame cannot be drawn.
    #[error(transparent)]
    Film(#[from] FilmError),
}

/// What a stream begins with, on one line.
#[derive(Debug, Serialize)]
pub struct Heading<'h> {
    /// Name of the environment whose scene is drawn.
    pub environment: &'h str,
    /// How it is drawn.
    pub rendering: &'h Rendering,
    /// Numbers of a state.
    pub positions: usize,
    /// Versions of what draws.
    pub versions: BTreeMap<String, String>,
}

/// Draws every state that comes on `states`; returns how many there were.
pub fn serve(
    (frames, heading): (&mut Frames, &Heading<'_>),
    mut states: impl Read,
    mut drawn: impl Write,
) -> Result<usize, StreamError> {
    let line = serde_json::to_string(heading).map_err(io::Error::from)?;
    writeln!(drawn, "{line}")?;
    drawn.flush()?;
    let mut state = vec![0; 8 * heading.positions];
    let mut positions = vec![0.0; heading.positions];
    let mut count = 0;
    loop {
        match fill(&mut states, &mut state)? {
            0 => return Ok(count),
            read if read < state.len() => {
                let wanted = state.len();
                return Err(StreamError::Cut { read, wanted });
            }
            _ => {}
        }
        for (position, &bytes) in positions.iter_mut().zip(state.as_chunks().0) {
            *position = f64::from_le_bytes(bytes);
        }
        drawn.write_all(frames.draw(&positions)?)?;
        drawn.flush()?;
        count += 1;
    }
}

/// Reads until `to` is full or the input ends; returns how many bytes came.
fn fill(from: &mut impl Read, to: &mut [u8]) -> io::Result<usize> {
    let mut read = 0;
    while read < to.len() {
        match from.read(&mut to[read..]) {
            Ok(0) => break,
            Ok(more) => read += more,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(read)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_buffer_is_filled_over_several_reads_and_an_end_is_told() {
        let mut parts = [1_u8, 2].as_slice().chain([3, 4, 5].as_slice());
        let mut to = [0; 4];
        assert_eq!(fill(&mut parts, &mut to).unwrap(), 4);
        assert_eq!(to, [1, 2, 3, 4]);
        assert_eq!(fill(&mut parts, &mut to).unwrap(), 1);
        assert_eq!(fill(&mut parts, &mut to).unwrap(), 0);
    }
}
