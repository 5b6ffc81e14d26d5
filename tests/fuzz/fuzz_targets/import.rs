//! Fuzzes imports: see `lads_tests::hostile::import`.
#![no_main]

libfuzzer_sys::fuzz_target!(|case: &[u8]| {
    lads_tests::hostile::import(case);
});
