//! Dense kernels for batch-1 policies.
#![no_std]
#![cfg_attr(
    not(test),
    deny(
        clippy::indexing_slicing,
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic
    )
)]

mod linear;

pub use linear::{PANEL, attention_scratch_len, pack, packed_len};
