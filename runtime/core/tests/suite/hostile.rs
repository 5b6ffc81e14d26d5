//! Tests that opening images that are broken, by accident or on purpose, and running those that
//! open, gives `Ok` or `Err`, never a panic.

use crate::support;
use crate::support::assemble::{self, RECORD};
use crate::support::layout::section_row;
use crate::support::writer::Parts;
use crate::support::{Image, Model, Random, Spec, given, observe, shapes};
use lads_core::{
    ChannelId, Controller, Data, Instruction, Noise, Policy, PolicyError, Role, RunError,
    StepError, Workspace,
};
use lads_image::codec::{Field, Reader, Writer};
use lads_image::format::{FormatError, Tag};
use lads_image::op::Op;
use lads_image::tables::TablesError;
use proptest::prelude::*;

/// Makes a LADS policy even smaller than the small one, because every byte of it is flipped.
fn lads() -> Parts {
    let spec = Spec {
        layers: 1,
        hidden: 6,
        head_dim: 3,
        codebook_len: 3,
        plan_len: 2,
        steps: 4,
        horizon: 2,
        ..Spec::TINY
    };
    assemble::parts(&Model::random(spec, 2))
}

/// One image of each shape, with a recorded episode.
fn all() -> Vec<(&'static str, Image)> {
    let mut all = shapes::all();
    all.push(("lads", lads()));
    all.into_iter()
        .map(|(name, parts)| (name, parts.with_golden(4).image()))
        .collect()
}

/// Largest workspace that these tests give; a changed size may ask for more, and refusing that is
/// the caller's part.
const MOST: usize = 1 << 16;

/// Largest work that these tests wait for; a changed number may ask for more.
const WORK: u64 = 1 << 16;

/// Uses an image that opens: every call may refuse, none may panic. Memory and time stay small.
fn exercise(bytes: &[u8]) -> Result<(), PolicyError> {
    let policy = Policy::new_within(bytes, WORK)?;
    policy.checksum_matches();
    let contract = policy.contract();
    for channel in contract.channels() {
        channel.elements().chain(channel.element(1)).for_each(drop);
    }
    contract.instructions().for_each(drop);
    let largest = contract
        .channels()
        .map(|channel| channel.len())
        .max()
        .unwrap_or(0);
    let small = [
        policy.arena_len(),
        policy.state_len(),
        policy.noise_len(),
        largest,
    ]
    .iter()
    .all(|&len| len <= MOST);
    if !small {
        return Ok(());
    }
    let (mut arena, mut state) = (vec![0.0; policy.arena_len()], vec![0.0; policy.state_len()]);
    let workspace = Workspace::new(&policy, &mut arena, &mut state).expect("the memory suffices");
    let mut controller = Controller::new(policy, workspace);
    let _ = controller.self_test();
    controller.warm();
    let _ = controller.set_instruction(Instruction::Id(0));
    for seed in 0..30 {
        one_step(&mut controller, &policy, seed);
    }
    Ok(())
}

fn one_step(controller: &mut Controller, policy: &Policy, seed: u64) {
    let mut random = Random(seed);
    let contract = policy.contract();
    let inputs = observe(policy, &mut random);
    let noise = random.vec(policy.noise_len(), 1.0);
    let mut given = given(&inputs);
    match seed {
        8 => controller.reset(),
        9 => controller.set_noise(Noise::Seeded { seed }),
        10 => drop(controller.set_instruction(Instruction::Words(&vec![0.5; contract.word_dim()]))),
        11 => controller.warm(),
        12.. => {
            let channel = contract
                .channels()
                .find(|channel| channel.role() == Role::Noise);
            given.extend(channel.map(|channel| (channel.id(), Data::F32(&noise))));
        }
        _ => {}
    }
    let mut action = vec![0.0; contract.action_len()];
    if controller.step_with(&given, &mut action).is_ok() {
        assert!(action.iter().all(|x| x.is_finite()), "{action:?}");
        controller.executed(&action).expect("it is a step's action");
    }
    let _ = controller.follow(&given, seed as u32 % 4, &mut action);
    let demonstrations: Vec<(ChannelId, Vec<f32>)> = contract
        .channels()
        .filter(|channel| channel.role() == Role::Demonstration)
        .map(|channel| (channel.id(), vec![0.1; channel.len()]))
        .collect();
    let demonstrations: Vec<_> = demonstrations
        .iter()
        .map(|(id, values)| (*id, Data::F32(values)))
        .collect();
    let _ = controller.encode(&demonstrations);
}

#[test]
fn every_truncation_is_refused() {
    for (name, image) in all() {
        assert_eq!(exercise(image.bytes()), Ok(()));
        for len in 0..image.bytes().len() {
            let refused = Policy::new_checked(&image.bytes()[..len]).map(|_| ());
            assert!(
                matches!(refused, Err(PolicyError::Tables(TablesError::Format(FormatError::Truncated { got, .. }))) if got == len),
                "{name} of {len} bytes: {refused:?}"
            );
        }
    }
}

#[test]
fn every_flipped_byte_is_found_by_the_checksum_and_never_a_panic() {
    for (name, image) in all() {
        let weights = image.0[section_row(Tag::Weights)[0]] as usize;
        let (mut tables, mut refused) = (0, 0);
        for at in 0..image.bytes().len() {
            let masks: &[u8] = if at < weights {
                &[0x01, 0x80, 0xff]
            } else {
                &[0xff]
            };
            for mask in masks {
                let mut changed = image.clone();
                bytemuck::cast_slice_mut::<u32, u8>(&mut changed.0)[at] ^= mask;
                if let Ok(policy) = Policy::new_checked(changed.bytes()) {
                    assert!(!policy.checksum_matches(), "{name}, byte {at}");
                }
                let table = at < weights;
                tables += usize::from(table);
                refused += usize::from(exercise(changed.bytes()).is_err() && table);
            }
        }
        // Half of the tables and ops cannot be changed without contradicting something; the rest are names, limits, seeds.
        assert!(
            2 * refused > tables,
            "{name}: {refused} of {tables} refused"
        );
    }
}

/// Largest number of words of tables and ops of an image in these tests.
const WORDS: usize = 4000;

fn any_word() -> impl Strategy<Value = u32> {
    prop_oneof![
        any::<u32>(),
        0_u32..64,
        Just(u32::MAX),
        Just(1 << 16),
        Just(1 << 31)
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 512, ..ProptestConfig::default() })]

    #[test]
    fn random_words_in_the_tables_never_panic(
        edits in prop::collection::vec((0..WORDS, any_word()), 1..6),
        shape in 0..10_usize,
    ) {
        let (_, image) = &all()[shape];
        let mut changed = image.clone();
        // Everything before the weights: header, contract, channels, states, entries, calls, ops.
        let tables = image.0[section_row(Tag::Weights)[0]] as usize / 4;
        for (at, value) in edits {
            changed.0[at % tables] = value;
        }
        let _ = exercise(changed.bytes());
    }

    #[test]
    fn random_records_never_panic(
        edits in prop::collection::vec((0_usize..6, 0..WORDS, any_word()), 1..4),
        sealed in any::<bool>(),
        shape in 0..9_usize,
    ) {
        let (_, mut parts) = shapes::all().swap_remove(shape);
        for (kind, at, value) in edits {
            edit(&mut parts, kind, at, value);
        }
        // With work and offsets put right, more of them get far enough to run.
        if sealed {
            if parts.states.iter().any(|state| u64::from(state.width) * (u64::from(state.rows) + 1) > 1 << 20) {
                return Ok(());
            }
            parts = parts.sealed();
        }
        let _ = exercise(parts.image().bytes());
    }

    #[test]
    fn random_bytes_are_no_image(bytes in prop::collection::vec(any::<u32>(), 0..200)) {
        prop_assert!(Policy::new_checked(bytemuck::cast_slice(&bytes)).is_err());
    }
}

/// Changes one word of a record, unless it then no longer decodes.
fn change<T: Field>(record: &mut T, at: usize, value: u32) {
    let mut words = vec![0; T::WORDS];
    record.put(&mut Writer::new(&mut words));
    words[at % T::WORDS] = value;
    if let Some(changed) = T::take(&mut Reader::new(&words)) {
        *record = changed;
    }
}

/// Picks one record of a list, if it has any.
fn pick<T>(list: &mut [T], which: usize) -> Option<&mut T> {
    let len = list.len().max(1);
    list.get_mut(which % len)
}

/// Changes one word of one record.
fn edit(parts: &mut Parts, kind: usize, at: usize, value: u32) {
    let (which, word) = (at / 32, at % 32);
    match kind {
        0 => change(&mut parts.contract, word, value),
        1 => change(&mut parts.channels[which % 2], word, value),
        2 => {
            if let Some(state) = pick(&mut parts.states, which) {
                change(state, word, value);
            }
        }
        3 => {
            let calls = parts.calls.len();
            change(&mut parts.calls[which % calls].record, word, value);
        }
        4 => {
            let entries = parts.entries.len();
            let entry = &mut parts.entries[which % entries];
            let port = if word < 16 {
                pick(&mut entry.inputs, word / 4)
            } else {
                pick(&mut entry.outputs, word / 4)
            };
            match (word % 4, port) {
                (0, _) => entry.cache = value,
                (1, _) => entry.tokens = value,
                (2, Some((source, _))) => change(source, which, value),
                (_, Some((_, place))) => change(place, which, value),
                (_, None) => {}
            }
        }
        _ => {
            let calls = parts.calls.len();
            parts.calls[which % calls].clears.push(value % 5);
        }
    }
}

#[test]
fn a_timestep_beyond_the_table_is_an_error_of_the_step() {
    let mut parts = lads();
    // The table of timesteps is read some rows too far.
    for op in &mut parts.entries[RECORD].ops {
        if let Op::GatherRow(op) = op {
            op.shift += 5;
        }
    }
    support::with_controller(&parts.image(), |controller| {
        let mut action = [0.0; 2];
        assert!(controller.step(&[0.0; 3], &mut action).is_ok());
        let before = action;
        let refused = controller.step(&[0.0; 3], &mut action);
        assert!(
            matches!(refused, Err(StepError::Run(RunError::Program(_)))),
            "{refused:?}"
        );
        assert_eq!(action, before);
    });
}
