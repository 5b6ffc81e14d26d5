//! Tests that the frame of an image and its records are read back as they were written, bit for
//! bit.

use lads_image::codec::{Field, Reader, Writer};
use lads_image::format::{self, HEADER_WORDS, Layout, SECTIONS, Sections, Tag};
use lads_image::op::{Activation, Attention, Place, WeightSpan};
use lads_image::records::{
    CallRecord, ChannelRecord, ContractRecord, ElementRecord, EntryRecord, GoldenRecord,
    InstructionRecord, PortRecord, StateRecord,
};
use proptest::prelude::*;

/// Returns the lengths of all sections, none of them zero.
fn lens() -> [usize; SECTIONS] {
    std::array::from_fn(|i| 4 * (i + 1))
}

#[test]
fn sections_follow_each_other_and_weights_are_aligned() {
    let layout = Layout::new(lens()).expect("the lengths are whole words");
    let spans: Vec<_> = Tag::ALL.iter().map(|&tag| layout.section(tag)).collect();
    assert!(
        spans
            .windows(2)
            .all(|pair| pair[0].offset + pair[0].len <= pair[1].offset)
    );
    assert_eq!(
        layout.section(Tag::Weights).offset % format::WEIGHTS_ALIGN,
        0
    );
    let last = spans.last().expect("there are sections");
    assert_eq!(layout.total_bytes(), last.offset + last.len);
    for wrong in [1, usize::MAX - 3, 1 << 32] {
        let mut lens = lens();
        lens[0] = wrong;
        assert_eq!(Layout::new(lens), None);
    }
}

#[test]
fn a_header_is_read_as_it_was_laid() {
    let layout = Layout::new(lens()).expect("the lengths are whole words");
    let mut words: Vec<u32> = (0..layout.total_bytes() as u32 / 4).collect();
    words[..HEADER_WORDS].copy_from_slice(&layout.header());
    let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
    assert_eq!(format::total_bytes(&bytes), Ok(layout.total_bytes()));
    let sections = Sections::new(&words).expect("the table is sound");
    for &tag in Tag::ALL {
        let span = layout.section(tag);
        assert_eq!(
            sections.get(tag),
            &words[span.offset / 4..(span.offset + span.len) / 4]
        );
    }
}

#[test]
fn the_checksum_is_that_of_zip() {
    // The check value of CRC-32/ISO-HDLC; the checksum's own word, bytes 12 to 15, counts as zero.
    assert_eq!(format::crc32(b"123456789"), 0xcbf4_3926);
    let mut bytes = [7_u8; 20];
    let before = format::crc32(&bytes);
    bytes[13] = 0;
    assert_eq!(format::crc32(&bytes), before);
    bytes[16] = 0;
    assert_ne!(format::crc32(&bytes), before);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn what_decodes_as_a_record_is_written_bit_for_bit(words in prop::collection::vec(0_u32..4, 48)) {
        fn written<T: Field>(words: &[u32]) -> bool {
            let words = &words[..T::WORDS];
            let mut again = vec![0; T::WORDS];
            T::take(&mut Reader::new(words)).is_none_or(|record| {
                record.put(&mut Writer::new(&mut again));
                again == words
            })
        }
        prop_assert!(written::<ContractRecord>(&words));
        prop_assert!(written::<ChannelRecord>(&words));
        prop_assert!(written::<ElementRecord>(&words));
        prop_assert!(written::<InstructionRecord>(&words));
        prop_assert!(written::<StateRecord>(&words));
        prop_assert!(written::<EntryRecord>(&words));
        prop_assert!(written::<PortRecord>(&words));
        prop_assert!(written::<CallRecord>(&words));
        prop_assert!(written::<GoldenRecord>(&words));
        prop_assert!(written::<Place>(&words));
        prop_assert!(written::<Option<WeightSpan>>(&words));
        prop_assert!(written::<Activation>(&words));
        prop_assert!(written::<Attention>(&words));
        prop_assert!(written::<[u64; 3]>(&words));
    }

    #[test]
    fn no_table_of_sections_makes_reading_panic(rows in prop::collection::vec(any::<u32>(), HEADER_WORDS), len in 64_usize..90) {
        let mut words = rows;
        words[format::COUNT_WORD] %= 20;
        words.resize(len, 0);
        if let Ok(sections) = Sections::new(&words) {
            for &tag in Tag::ALL {
                prop_assert!(sections.get(tag).len() <= len);
            }
        }
    }
}
