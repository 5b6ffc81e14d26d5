//! Fuzzes bundles: see `lads_tests::hostile::bundle`.
#![no_main]

libfuzzer_sys::fuzz_target!(|edits: &[u8]| lads_tests::hostile::bundle(edits));
