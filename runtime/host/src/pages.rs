//! Zeroed memory in large pages, where the operating system has them.
//!
//! At a robot's rate a control step finds little of its memory in the caches, and none of its pages
//! in the processor's translation tables: a page of 4 KiB costs a walk through the operating
//! system's, one of 2 MiB stands for 512 of them. Linux gives large pages to those who ask
//! (`/sys/kernel/mm/transparent_hugepage/enabled`: `madvise` or `always`); elsewhere this is
//! ordinary memory.

use std::io;

use bytemuck::AnyBitPattern;
use memmap2::MmapMut;

/// Size of a large page in bytes, and the alignment of the memory.
const LARGE: usize = 2 << 20;

/// Zeroed bytes at a multiple of 2 MiB.
#[derive(Debug)]
pub(crate) struct Pages {
    /// Mapping whose used bytes begin at `start`.
    map: MmapMut,
    start: usize,
    len: usize,
}

impl Pages {
    /// Allocates `len` bytes; fails if the operating system has no such address space.
    pub fn zeroed(len: usize) -> io::Result<Self> {
        let map = MmapMut::map_anon(len.saturating_add(LARGE))?;
        // A kernel without large pages refuses the advice, and nothing is lost.
        #[cfg(target_os = "linux")]
        let _ = map.advise(memmap2::Advice::HugePage);
        let start = map.as_ptr().align_offset(LARGE).min(LARGE);
        Ok(Self { map, start, len })
    }

    /// Memory that `len` bytes may come to take: whole large pages on Linux.
    pub fn taken(len: usize) -> usize {
        if cfg!(target_os = "linux") {
            len.checked_next_multiple_of(LARGE).unwrap_or(usize::MAX)
        } else {
            len
        }
    }

    /// Returns the bytes.
    pub fn as_bytes(&self) -> &[u8] {
        &self.map[self.start..self.start + self.len]
    }

    /// Returns the bytes as numbers.
    pub fn as_mut<T: AnyBitPattern + bytemuck::NoUninit>(&mut self) -> &mut [T] {
        bytemuck::cast_slice_mut(&mut self.map[self.start..self.start + self.len])
    }
}

#[cfg(test)]
mod tests {
    use super::{LARGE, Pages};

    #[test]
    fn bytes_are_zero_and_start_at_a_large_page() {
        for len in [0, 4, 3 * LARGE + 8] {
            let mut pages = Pages::zeroed(len).unwrap();
            assert_eq!(pages.as_bytes().as_ptr().addr() % LARGE, 0);
            assert!(pages.as_bytes().len() == len && pages.as_bytes().iter().all(|&b| b == 0));
            pages.as_mut::<f32>().fill(1.0);
            assert_eq!(pages.as_mut::<f32>().len(), len / 4);
        }
    }

    #[test]
    fn what_bytes_take_is_no_less_than_they_are() {
        for len in [0, 4, LARGE, LARGE + 1, usize::MAX] {
            let taken = Pages::taken(len);
            assert!(taken >= len && taken - len < LARGE, "{len}");
        }
    }

    #[test]
    fn more_than_there_is_is_refused() {
        assert!(Pages::zeroed(usize::MAX).is_err());
    }
}
