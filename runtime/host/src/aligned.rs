//! Image bytes at an address with the alignment that weights need.

use std::alloc::{Layout, handle_alloc_error};

use crate::pages::Pages;

/// Bytes whose address is a multiple of a cache line and of a page.
#[derive(Debug)]
pub struct Aligned(Pages);

impl Aligned {
    /// Copies `bytes`; if memory runs out, the program aborts as it does for a `Vec`.
    pub fn new(bytes: &[u8]) -> Self {
        let mut pages = Pages::zeroed(bytes.len())
            .unwrap_or_else(|_| handle_alloc_error(Layout::for_value(bytes)));
        pages.as_mut().copy_from_slice(bytes);
        Self(pages)
    }

    /// Returns the bytes.
    pub fn as_bytes(&self) -> &[u8] {
        self.0.as_bytes()
    }
}
