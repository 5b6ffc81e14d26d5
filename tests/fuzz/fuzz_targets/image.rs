//! Fuzzes program images: see `lads_tests::hostile::image`.
#![no_main]

libfuzzer_sys::fuzz_target!(|edits: &[u8]| lads_tests::hostile::image(edits));
