//! Bytes of an image at an address as weights want it.

use lads_core::image::WEIGHTS_ALIGN;

/// Bytes whose address is a multiple of 64.
#[derive(Debug)]
pub struct Aligned {
    /// The bytes start at `start`.
    memory: Vec<u8>,
    start: usize,
    len: usize,
}

impl Aligned {
    /// A copy of `bytes`.
    pub fn new(bytes: &[u8]) -> Self {
        let mut memory = vec![0; bytes.len() + WEIGHTS_ALIGN];
        let start = memory.as_ptr().align_offset(WEIGHTS_ALIGN);
        let start = start.min(WEIGHTS_ALIGN);
        memory[start..start + bytes.len()].copy_from_slice(bytes);
        Self {
            memory,
            start,
            len: bytes.len(),
        }
    }

    /// The bytes.
    pub fn as_bytes(&self) -> &[u8] {
        &self.memory[self.start..self.start + self.len]
    }
}
