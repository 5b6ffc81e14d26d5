//! Suites that need more than one crate; the code is in `tests/`.
#![forbid(unsafe_code)]
