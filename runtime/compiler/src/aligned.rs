//! Image words at an address with the alignment that weights need.

use lads_image::format::WEIGHTS_ALIGN;

/// Number of words in a line of weights.
const LINE: usize = WEIGHTS_ALIGN / size_of::<u32>();

/// Words whose address is a multiple of [`WEIGHTS_ALIGN`].
#[derive(Debug)]
pub(crate) struct Aligned {
    /// Allocation whose used words begin at `start`; they do not move when this value is moved.
    words: Vec<u32>,
    start: usize,
    len: usize,
}

impl Aligned {
    /// Copies `words`.
    pub fn new(words: &[u32]) -> Self {
        let len = words.len();
        let mut room = vec![0; len + LINE];
        let start = room.as_ptr().align_offset(WEIGHTS_ALIGN).min(LINE);
        room[start..start + len].copy_from_slice(words);
        Self {
            words: room,
            start,
            len,
        }
    }

    /// Returns the words as bytes.
    pub fn as_bytes(&self) -> &[u8] {
        bytemuck::cast_slice(&self.words[self.start..self.start + self.len])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_start_where_weights_may() {
        for len in [0, 1, 100, 1 << 20] {
            let words: Vec<u32> = (0..len).collect();
            let aligned = Aligned::new(&words);
            assert_eq!(aligned.as_bytes().as_ptr().addr() % WEIGHTS_ALIGN, 0);
            assert_eq!(aligned.as_bytes(), bytemuck::cast_slice::<u32, u8>(&words));
        }
    }
}
