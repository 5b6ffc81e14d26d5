//! Tests every family of policies beside ONNX Runtime: random policies of small size, driven by a recorded episode with two instructions,
//! resets and restarts of the context; see [`lads_tests::episode`].
//!
//! For each: equal selections and actions within a tolerance; the same bits on every instruction set, and whether noise is given or drawn
//! by the runtime; nothing allocated; and whatever is done to the image's bytes, it is refused or runs.

use std::collections::HashSet;

use lads_compiler::{Bundle, Image, compile};
use lads_core::{Isa, Policy};
use lads_host::Memory;
use lads_image::format::{CRC_WORD, HEADER_WORDS, TABLE_WORD, Tag, crc32};
use lads_tests::episode::{Episode, folder, kinds};
use lads_tests::hostile::{open_and_drive, open_and_step};

#[path = "common/counting.rs"]
mod counting;

/// Largest allowed difference of an action from ONNX Runtime's.
const TOLERANCE: f32 = 1e-5;

/// Interval of the bytes that are flipped in weights and the golden episode, whose values no check depends on.
const SPARSE: usize = 997;

/// Largest number of bytes that are flipped outside weights and golden episode, evenly spread: where each of them is a step of many passes,
/// all of them take minutes.
const MOST: usize = 30_000;

/// Where this variable of the environment is set, every byte is flipped, which takes more than an hour of one core for all families.
const EVERY_BYTE: &str = "LADS_EVERY_BYTE";

fn image(kind: &str) -> Image {
    let bundle = Bundle::open(&folder().join(format!("{kind}.onnx")));
    let bundle = bundle.unwrap_or_else(|error| panic!("{error}"));
    compile(&bundle).unwrap_or_else(|error| panic!("{kind}: {error}"))
}

fn episode(kind: &str, policy: &Policy) -> Episode {
    Episode::open(&folder().join(format!("{kind}.safetensors")), policy)
}

/// Runs a policy through its recorded episode and compares with ONNX Runtime.
fn replay(kind: &str) {
    let image = image(kind);
    let policy = Policy::new_checked(image.as_bytes());
    let policy = policy.unwrap_or_else(|error| panic!("{kind}: {error}"));
    let episode = episode(kind, &policy);
    let mut memory = Memory::of(&policy).expect("there is memory");
    let mut controller = memory.controller(&policy).expect("it was made for it");
    controller
        .self_test()
        .unwrap_or_else(|error| panic!("{kind}: {error}"));
    let contract = policy.contract();
    let mut action = vec![0.0; contract.action_len()];
    let mut restarts = 0;
    let inputs = episode.inputs(true);
    episode.drive(
        &mut controller,
        &inputs,
        &mut action,
        |step, report, action| {
            restarts += usize::from(episode.events[step] == -1 && step > 0 && report.timestep == 0);
            let index = report.selected.map_or(-1, |found| i64::from(found.index));
            let wanted = episode.selected[step];
            assert_eq!(index, wanted, "{kind}, step {step}: selected index");
            let wanted = &episode.actions[step * action.len()..];
            for (i, (&got, &wanted)) in action.iter().zip(wanted).enumerate() {
                let near = (got - wanted).abs() <= TOLERANCE;
                assert!(
                    near,
                    "{kind}, step {step}, element {i}: {got}, ONNX Runtime gives {wanted}"
                );
            }
        },
    );
    assert!(episode.steps() >= 200, "{kind}: {} steps", episode.steps());
    let instructions: HashSet<_> = episode.events.iter().filter(|&&event| event >= 0).collect();
    if contract.instruction_channel().is_some() {
        assert!(instructions.len() > 1, "{kind}: {instructions:?}");
    }
    assert!(episode.events.contains(&-2), "{kind}: a reset");
    if contract.context_steps().is_some() {
        assert!(restarts > 0, "{kind}: the context starts again");
    }
}

/// Returns the bits of all actions, and the selected indices, of the recorded episode.
fn bits(policy: &Policy, isa: Isa, with_noise: bool, episode: &Episode) -> Vec<(i64, Vec<u32>)> {
    let mut memory = Memory::of(policy).expect("there is memory");
    let mut controller = memory
        .controller_with(policy, isa)
        .expect("it was made for it");
    let mut action = vec![0.0; policy.contract().action_len()];
    let (inputs, mut seen) = (episode.inputs(with_noise), vec![]);
    episode.drive(
        &mut controller,
        &inputs,
        &mut action,
        |_, report, action| {
            let index = report.selected.map_or(-1, |found| i64::from(found.index));
            seen.push((index, action.iter().map(|x| x.to_bits()).collect()));
        },
    );
    seen
}

fn same_bits(kind: &str) {
    let image = image(kind);
    let policy = Policy::new_checked(image.as_bytes()).expect("the image opens");
    let episode = episode(kind, &policy);
    let first = bits(&policy, Isa::portable(), true, &episode);
    for isa in Isa::all() {
        let other = bits(&policy, isa, true, &episode);
        assert!(first == other, "{kind}: other bits on {isa:?}");
    }
    if policy.contract().noise_channel().is_some() {
        assert!(episode.is_noisy(), "{kind}: the episode has its noise");
        // From the contract's seed: the generator's normals are those that the exporter's twin drew.
        let drawn = bits(&policy, Isa::detect(), false, &episode);
        assert!(first == drawn, "{kind}: other bits with its own noise");
    }
}

fn allocates_nothing(kind: &str) {
    let image = image(kind);
    let policy = Policy::new_checked(image.as_bytes()).expect("the image opens");
    let episode = episode(kind, &policy);
    let mut memory = Memory::of(&policy).expect("there is memory");
    let mut controller = memory.controller(&policy).expect("it was made for it");
    let mut action = vec![0.0; policy.contract().action_len()];
    let inputs = episode.inputs(false);
    let counted = counting::calls_during(|| drop(std::hint::black_box(vec![1])));
    assert!(counted >= 2, "the counter counts");
    let mut steps = 0;
    let calls = counting::calls_during(|| {
        episode.drive(&mut controller, &inputs, &mut action, |_, _, _| steps += 1);
    });
    assert!(steps >= 200, "{kind}: {steps} steps");
    assert_eq!(calls, 0, "{kind}");
}

/// Tests every truncation, with and without the header's length set right, and flips in all that is checked.
fn damaged(kind: &str) {
    let image = image(kind);
    let whole = image.as_bytes();
    open_and_drive(whole);
    for len in 0..whole.len() {
        assert!(!opens(&whole[..len]), "{kind}: {len} bytes open");
    }
    let word = |at: usize| u32::from_le_bytes(std::array::from_fn(|i| whole[at * 4 + i])) as usize;
    let sections: Vec<[usize; 3]> = (TABLE_WORD..HEADER_WORDS - 2)
        .step_by(3)
        .map(|at| [word(at), word(at + 1), word(at + 2)])
        .collect();
    let values = [Tag::Weights as usize, Tag::Golden as usize];
    let all = std::env::var_os(EVERY_BYTE).is_some();
    let sparse = |at: usize| {
        let mut found = sections.iter();
        !all && found
            .any(|[tag, from, len]| values.contains(tag) && (*from..from + len).contains(&at))
    };
    let dense = (0..whole.len()).filter(|&at| !sparse(at)).count();
    // Odd, so that every byte of a word has its turn.
    let every = if all { 1 } else { dense.div_ceil(MOST) | 1 };
    for len in (HEADER_WORDS * 4..whole.len()).step_by(4) {
        if sparse(len) && !len.is_multiple_of(4 * SPARSE) {
            continue;
        }
        let mut bytes = whole[..len].to_vec();
        bytes[8..12].copy_from_slice(&(len as u32).to_le_bytes());
        sealed(&mut bytes);
        assert!(!opens(&bytes), "{kind}: {len} bytes that say so open");
    }
    let mut flipped = 0;
    for at in 0..whole.len() {
        let step = if sparse(at) { SPARSE } else { every };
        if !at.is_multiple_of(step) {
            continue;
        }
        let mut bytes = whole.to_vec();
        bytes[at] ^= 1 << (at % 8);
        sealed(&mut bytes);
        let survived = std::panic::catch_unwind(|| open_and_step(&bytes));
        assert!(survived.is_ok(), "{kind}: byte {at}");
        flipped += 1;
    }
    println!("{kind}: {} truncations, {flipped} flips", whole.len());
}

/// Sets the right checksum of an image.
fn sealed(bytes: &mut [u8]) {
    let crc = crc32(bytes);
    bytes[CRC_WORD * 4..][..4].copy_from_slice(&crc.to_le_bytes());
}

/// Whether an image, copied to aligned memory as images need, opens.
fn opens(bytes: &[u8]) -> bool {
    let mut aligned = vec![0_u32; bytes.len().div_ceil(4)];
    let memory: &mut [u8] = bytemuck::cast_slice_mut(&mut aligned);
    memory[..bytes.len()].copy_from_slice(bytes);
    Policy::new_checked(&memory[..bytes.len()]).is_ok()
}

macro_rules! kinds {
    ($($kind:ident)*) => {
        $(mod $kind {
            use super::*;

            const KIND: &str = stringify!($kind);

            #[test]
            #[ignore = "needs random bundles: tests/parity/test_families.py makes them and runs this"]
            fn beside_onnx_runtime() {
                replay(KIND);
            }

            #[test]
            #[ignore = "needs random bundles: tests/parity/test_families.py makes them and runs this"]
            fn same_bits_everywhere() {
                same_bits(KIND);
            }

            #[test]
            #[ignore = "needs random bundles: tests/parity/test_families.py makes them and runs this"]
            fn allocates_nothing() {
                super::allocates_nothing(KIND);
            }

            #[test]
            #[ignore = "needs random bundles: tests/parity/test_families.py makes them and runs this"]
            fn damaged_images_are_refused_or_run() {
                damaged(KIND);
            }
        })*

        #[test]
        #[ignore = "needs random bundles: tests/parity/test_families.py makes them and runs this"]
        fn every_kind_has_its_tests() {
            let mut tested = [$(stringify!($kind),)*];
            tested.sort();
            assert_eq!(kinds(), tested);
        }
    };
}

kinds! {
    lads
    lang_dt
    lisa
    vae
    lcsd
    skilldiffuser
    history
    vae_history
    plain
    recurrent
    stacked
    camera
    images
    frozen_lang_dt
    frozen_lisa
    frozen_vae_history
    sighted
    sighted_history
    sighted_lang_dt
    sighted_lisa
    sighted_vae
}
