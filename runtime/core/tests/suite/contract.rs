//! Tests of every rule about the frame of an image, its contract and its recorded episode, violated
//! once.

use crate::support;
use crate::support::assemble::{self, ACTION, ACTIONS, OBSERVATION, WORDS};
use crate::support::layout::section_row;
use crate::support::writer::Parts;
use crate::support::{Image, Model, Spec, shapes};
use lads_core::{ChannelId, ContractError, Policy, PolicyError};
use lads_image::format::{CRC_WORD, FormatError, Tag};
use lads_image::records::{self, DType, Role};
use lads_image::tables::TablesError;

fn lads() -> Parts {
    assemble::parts(&Model::random(Spec::TINY, 11)).with_golden(4)
}

/// Returns why a policy is refused after `edit`, which has to be its contract's fault.
fn fault(parts: &Parts, edit: impl FnOnce(&mut Parts)) -> Option<ContractError> {
    match parts.refused(edit) {
        Some(PolicyError::Contract(error)) => Some(error),
        Some(other) => panic!("refused for another reason: {other:?}"),
        None => None,
    }
}

#[test]
fn numbers_make_sense() {
    let sound = lads();
    assert_eq!(fault(&sound, |_| ()), None);
    let number = Some(ContractError::Number);
    for wrong in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        assert_eq!(
            fault(&sound, |parts| parts.contract.control_period_s = wrong),
            number
        );
        assert_eq!(
            fault(&sound, |parts| parts.contract.temperature = wrong),
            number
        );
    }
    for wrong in [f32::NAN, f32::INFINITY] {
        assert_eq!(
            fault(&sound, |parts| parts.contract.acceptance = wrong),
            number
        );
    }
}

#[test]
fn channels_are_observations_and_one_action() {
    let sound = lads();
    let channels = Some(ContractError::Channels);
    let edit = |channel: u32, edit: &dyn Fn(&mut records::ChannelRecord)| {
        fault(&sound, |parts| edit(&mut parts.channels[channel as usize]))
    };
    assert_eq!(
        edit(OBSERVATION, &|c| c.role = Role::Demonstration),
        channels
    );
    assert_eq!(edit(ACTION, &|c| c.role = Role::Observation), channels);
    assert_eq!(edit(OBSERVATION, &|c| c.role = Role::Action), channels);
    assert_eq!(edit(ACTIONS, &|c| c.role = Role::Instruction), channels);
    for role in [Role::Instruction, Role::Noise, Role::Demonstration] {
        for dtype in [DType::U8, DType::I32] {
            let changed = edit(ACTIONS, &|c| (c.role, c.dtype) = (role, dtype));
            assert_eq!(changed, channels, "{role:?} {dtype:?}");
        }
    }
    let three_axes = |c: &mut records::ChannelRecord| (c.rank, c.dims) = (3, [4, 2, 2, 1]);
    assert_eq!(edit(WORDS, &three_axes), channels);
    let name = sound.channels[0].name;
    assert_eq!(edit(ACTION, &|c| c.name = name), channels);
    // An element that belongs to no channel.
    let elements = fault(&sound, |parts| parts.elements.push(parts.elements[0]));
    assert_eq!(elements, channels);
    let more = |role, count: usize| {
        fault(&sound, |parts| {
            for i in 0..count {
                parts.channel(&format!("more {i}"), role, DType::F32, &[1, 1], [-1.0, 1.0]);
            }
        })
    };
    // A step has room for sixteen observations, an image for so many channels that finding one takes no time.
    assert_eq!(
        more(Role::Observation, lads_core::MAX_OBSERVATIONS),
        channels
    );
    assert_eq!(more(Role::Demonstration, 50), None);
    assert_eq!(
        [more(Role::Noise, 1), more(Role::Noise, 2)],
        [None, channels]
    );
    assert_eq!(more(Role::Action, 1), channels);
    assert_eq!(more(Role::Instruction, 1), channels);
    assert_eq!(more(Role::Demonstration, 124), channels);
}

#[test]
fn shapes_are_as_long_as_their_elements() {
    let sound = lads();
    let shape = |channel| {
        Some(ContractError::Shape {
            channel: ChannelId(channel),
        })
    };
    let edit = |edit: &dyn Fn(&mut records::ChannelRecord)| {
        fault(&sound, |parts| edit(&mut parts.channels[0]))
    };
    for rank in [0, 5, u32::MAX] {
        assert_eq!(edit(&|c| c.rank = rank), shape(0));
    }
    for dims in [
        [0, 1, 1, 1],
        [4, 1, 1, 1],
        [3, 2, 1, 1],
        [u32::MAX, 1, 1, 1],
        [3, 1, 1, 0],
    ] {
        assert_eq!(edit(&|c| c.dims = dims), shape(0), "{dims:?}");
    }
    let huge = |c: &mut records::ChannelRecord| {
        (c.rank, c.dims, c.elements_len) = (4, [u32::MAX; 4], 0);
    };
    assert_eq!(edit(&huge), shape(0));
    assert_eq!(edit(&|c| c.elements_len = 2), shape(0));
    assert_eq!(edit(&|c| c.first_element = 1), shape(0));
    assert_eq!(edit(&|c| c.name.len = 0), shape(0));
    // The elements of two channels are not shared.
    assert_eq!(
        fault(&sound, |parts| parts.channels[ACTION as usize]
            .first_element = 0),
        shape(ACTION)
    );
}

#[test]
fn limits_are_ordered_numbers() {
    let sound = lads();
    let limits = |channel| {
        Some(ContractError::Limits {
            channel: ChannelId(channel),
        })
    };
    for (min, max) in [
        (1.0, -1.0),
        (f32::NAN, 1.0),
        (-1.0, f32::NAN),
        (f32::NEG_INFINITY, 0.0),
        (0.0, f32::INFINITY),
    ] {
        let edit = |parts: &mut Parts| (parts.elements[1].min, parts.elements[1].max) = (min, max);
        assert_eq!(fault(&sound, edit), limits(OBSERVATION));
        let edit = |parts: &mut Parts| (parts.channels[1].min, parts.channels[1].max) = (min, max);
        assert_eq!(fault(&sound, edit), limits(WORDS));
    }
    for wrong in [f32::NAN, f32::INFINITY] {
        assert_eq!(
            fault(&sound, |parts| parts.elements[3].scale = wrong),
            limits(ACTION)
        );
        assert_eq!(
            fault(&sound, |parts| parts.elements[4].offset = wrong),
            limits(ACTION)
        );
    }
    // Integers have one pair of limits.
    let integers = fault(&sound, |parts| parts.channels[0].dtype = DType::I32);
    assert_eq!(integers, limits(OBSERVATION));
}

#[test]
fn instructions_have_words() {
    let sound = lads();
    let words = Some(ContractError::Words);
    for (len, elements) in [(0, 0), (5, 20), (4, 15), (3, 16), (u32::MAX, 16)] {
        let edit = |parts: &mut Parts| {
            let known = &mut parts.instructions[0];
            (known.words_len, known.words.len) = (len, elements);
        };
        assert_eq!(
            fault(&sound, edit),
            words,
            "{len} words of {elements} elements"
        );
    }
    let mut parts = shapes::memoryless();
    parts.instruction(2, &[0.0; 2]);
    assert_eq!(fault(&parts, |_| ()), words);
}

#[test]
fn the_recorded_episode_agrees_with_the_contract() {
    fn golden(
        parts: &Parts,
        edit: impl FnOnce(&mut support::writer::Episode),
    ) -> Option<PolicyError> {
        parts.refused(|parts| edit(parts.golden.as_mut().expect("there is one")))
    }
    let refused = Some(PolicyError::Golden);
    let sound = lads();
    assert_eq!(golden(&sound, |_| ()), None);
    for steps in [0, 3, 5, u32::MAX] {
        assert_eq!(
            golden(&sound, |g| g.record.steps = steps),
            refused,
            "{steps}"
        );
    }
    for instruction in [2, records::NONE] {
        assert_eq!(
            golden(&sound, |g| g.record.instruction = instruction),
            refused
        );
    }
    for tolerance in [-1.0, f32::NAN, f32::INFINITY] {
        assert_eq!(golden(&sound, |g| g.record.tolerance = tolerance), refused);
    }
    let unselected = |g: &mut support::writer::Episode| {
        g.record.selects = false;
        g.selected.clear();
    };
    assert_eq!(golden(&sound, unselected), refused);
    assert_eq!(golden(&sound, |g| g.actions.truncate(7)), refused);
    assert_eq!(golden(&sound, |g| g.actions.push(0.0)), refused);
    assert_eq!(golden(&sound, |g| g.record.noise_len = 1), refused);

    let denoise = shapes::denoise().with_golden(2);
    let quieter = |g: &mut support::writer::Episode| {
        g.record.noise_len = 7;
        g.noise.truncate(14);
    };
    assert_eq!(golden(&denoise, quieter), refused);
    assert_eq!(golden(&denoise, |g| g.record.instruction = 0), refused);
    let queue = shapes::queue().with_golden(2);
    let selecting = |g: &mut support::writer::Episode| {
        g.record.selects = true;
        g.selected = vec![0, 0];
    };
    assert_eq!(golden(&queue, selecting), refused);
}

fn edited(image: &Image, word: usize, value: u32) -> Option<PolicyError> {
    let mut changed = image.clone();
    changed.0[word] = value;
    changed.refused()
}

#[test]
fn the_header_is_read_first() {
    let image = lads().image();
    let format = |error| Some(PolicyError::Tables(TablesError::Format(error)));
    assert_eq!(edited(&image, 0, 0x1234), format(FormatError::Magic));
    for version in [0, 4, 6, u32::MAX] {
        assert_eq!(
            edited(&image, 1, version),
            format(FormatError::Version(version))
        );
    }
    for length in [0, 3, 252, image.bytes().len() as u32 - 1] {
        assert_eq!(
            edited(&image, 2, length),
            format(FormatError::Length),
            "{length}"
        );
    }
    let (got, needed) = (image.bytes().len(), 0x7fff_fffc);
    assert_eq!(
        edited(&image, 2, needed as u32),
        format(FormatError::Truncated { got, needed })
    );
    assert_eq!(edited(&image, 4, 19), format(FormatError::Table));
    assert_eq!(edited(&image, 4, u32::MAX), format(FormatError::Table));
    assert_eq!(edited(&image, CRC_WORD, 0), None);
    let bytes = image.bytes();
    let mut shifted = vec![0_u8; bytes.len() + 4];
    let odd = usize::from((shifted.as_ptr() as usize).is_multiple_of(2));
    shifted[odd..odd + bytes.len()].copy_from_slice(bytes);
    let refused = Policy::new_checked(&shifted[odd..odd + bytes.len()]).err();
    assert_eq!(refused, Some(PolicyError::Tables(TablesError::Alignment)));
}

#[test]
fn bytes_behind_the_image_and_sections_of_other_tags_are_ignored() {
    let mut image = lads().image();
    image.0.extend([u32::MAX; 5]);
    assert!(image.policy().checksum_matches());
    // An unknown tag: the golden section is no longer found.
    let [offset, _] = section_row(Tag::Golden);
    image.0[offset - 1] = u32::from_le_bytes(*b"LATE");
    assert!(image.policy().golden().is_none());
}

#[test]
fn sections_follow_each_other_and_hold_whole_records() {
    let image = lads().image();
    let table = Some(PolicyError::Tables(TablesError::Format(FormatError::Table)));
    let section = |tag| Some(PolicyError::Tables(TablesError::Section(tag)));
    let record = |tag| Some(PolicyError::Tables(TablesError::Record(tag)));
    let row = |tag| section_row(tag);
    let at = |word: usize| image.0[word];
    // The golden section moved into the weights: all of it is still inside the image.
    let [golden, golden_len] = row(Tag::Golden);
    assert_eq!(edited(&image, golden, at(golden) - 4), table);
    assert_eq!(edited(&image, golden_len, at(golden_len) + 4), table);
    assert_eq!(edited(&image, golden_len, u32::MAX), table);
    assert_eq!(edited(&image, row(Tag::Contract)[0], 0), table);
    let [_, weights_len] = row(Tag::Weights);
    assert_eq!(edited(&image, weights_len, at(weights_len) - 2), table);
    for tag in [
        Tag::Channels,
        Tag::Elements,
        Tag::Instructions,
        Tag::States,
        Tag::Entries,
        Tag::Ports,
        Tag::Calls,
        Tag::Ops,
    ] {
        let [_, len] = row(tag);
        assert_eq!(edited(&image, len, at(len) - 4), section(tag), "{tag:?}");
    }
    let [_, contract_len] = row(Tag::Contract);
    assert_eq!(
        edited(&image, contract_len, at(contract_len) - 4),
        record(Tag::Contract)
    );
    let strings = at(row(Tag::Strings)[0]) as usize / 4;
    assert_eq!(edited(&image, strings, u32::MAX), section(Tag::Strings));
    // A text beyond the strings, a part beyond its table.
    let first = |tag| at(row(tag)[0]) as usize / 4;
    for tag in [
        Tag::Contract,
        Tag::Channels,
        Tag::Elements,
        Tag::Instructions,
        Tag::States,
        Tag::Entries,
        Tag::Ports,
    ] {
        assert_eq!(edited(&image, first(tag), u32::MAX), record(tag), "{tag:?}");
    }
    let clears = shapes::chunks().image();
    let calls = clears.0[row(Tag::Calls)[0]] as usize / 4;
    // The last word but one of a call: the first of its clears.
    assert_eq!(edited(&clears, calls + 8, 7), record(Tag::Calls));
}
