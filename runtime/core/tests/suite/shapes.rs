//! Compares each shape of a schedule with a few lines of Rust that compute the same: KV caches that
//! calls clear, repeated calls, noise, rings as windows and row by row, queues, recurrent states,
//! images and integers. Without attention, the results agree bit for bit.

use crate::support::shapes::{self, CODES, GEAR, LEANS, MEMORY, NOISE, PASSES, STEPS, WORDS};
use crate::support::{Random, attend, wide, with_controller};
use lads_core::{ChannelId, Data, Instruction, InstructionError, Noise, StepError};
use lads_image::records::Fill;

/// Returns random actions that nothing clips.
fn small(random: &mut Random) -> [f32; 2] {
    [random.next() * 0.25, random.next() * 0.25]
}

fn step(
    controller: &mut lads_core::Controller,
    observation: &[f32],
) -> ([f32; 2], lads_core::StepReport) {
    let mut action = [f32::NAN; 2];
    let report = controller
        .step(observation, &mut action)
        .expect("the step is sound");
    (action, report)
}

fn clip(x: [f32; 2]) -> [f32; 2] {
    x.map(|x| x.clamp(-1.0, 1.0))
}

/// Returns the scores, and the first of the largest.
fn best(x: &[f64]) -> (Vec<f64>, u32) {
    let scores: Vec<f64> = (0..3)
        .map(|i| x[0] * f64::from(LEANS[0][i]) + x[1] * f64::from(LEANS[1][i]))
        .collect();
    let best = (0..3).fold(0, |best, i| if scores[i] > scores[best] { i } else { best });
    (scores, best as u32)
}

fn near(got: &[f32], expected: &[f64]) {
    for (got, expected) in got.iter().zip(expected) {
        assert!(
            (f64::from(*got) - expected).abs() < 1e-5,
            "{got} against {expected}"
        );
    }
}

#[test]
fn every_shape_opens_and_its_recorded_episode_passes() {
    for (name, parts) in shapes::all() {
        let image = parts.with_golden(13).image();
        assert!(image.policy().checksum_matches());
        let tested = with_controller(&image, |controller| {
            controller
                .self_test()
                .map(|test| (test.steps, test.largest_error))
        });
        assert_eq!(tested, Ok((13, 0.0)), "{name}");
    }
}

#[test]
fn a_call_clears_one_of_two_caches() {
    let image = shapes::chunks().image();
    with_controller(&image, |controller| {
        let mut random = Random(3);
        for (id, reset) in [(1, false), (0, false), (0, true)] {
            if reset {
                controller.reset();
            } else {
                controller
                    .set_instruction(Instruction::Id(id))
                    .expect("it is known");
            }
            let words: Vec<Vec<f64>> = WORDS[id as usize].chunks(2).map(wide).collect();
            let (mut high, mut low, mut code) = (Vec::new(), Vec::new(), Vec::new());
            let (mut previous, mut index) = ([0.0; 2], 0);
            // Two contexts and a half.
            for i in 0..10_usize {
                let t = i % 4;
                let observation = random.vec(2, 0.5);
                if t == 0 {
                    high.clone_from(&words);
                }
                high.push(
                    (0..2)
                        .map(|j| f64::from(observation[j] + STEPS[t][j]))
                        .collect(),
                );
                if t.is_multiple_of(2) {
                    let (scores, selected) = best(&attend(&high));
                    (index, code) = (selected, wide(&CODES[selected as usize]));
                    low.clear();
                    let (action, report) = step(controller, &observation);
                    near(controller.scores(), &scores);
                    low.extend([code.clone(), wide(&observation)]);
                    near(&action, &attend(&low));
                    let selected = report.selected.expect("it selects");
                    assert!(selected.fresh && selected.index == index);
                    previous = action;
                } else {
                    let (action, report) = step(controller, &observation);
                    low.extend([wide(&previous), code.clone(), wide(&observation)]);
                    near(&action, &attend(&low));
                    let selected = report.selected.expect("it selects");
                    assert!(!selected.fresh && selected.index == index);
                    previous = action;
                }
            }
        }
    });
}

/// Computes in `f64` the action of [`shapes::denoise`] for the noise of one step.
fn denoised(observation: &[f32], noise: &[f32]) -> [f32; 2] {
    let code = CODES[best(&wide(observation)).1 as usize];
    let mut x = [0, 1].map(|j| noise[j] * 0.5);
    for pass in 0..PASSES as usize {
        x = [0, 1]
            .map(|j| (x[j] * 0.5 + STEPS[pass][j]) + (noise[2 * pass + 2 + j] * 0.25 + code[j]));
    }
    clip([0, 1].map(|j| x[j] + observation[j]))
}

/// Returns the first numbers of a seed's stream, from the table that both implementations are
/// tested against.
fn normals(seed: u64) -> Vec<f32> {
    let head = format!("draws {seed} ");
    let row = include_str!("../normals.txt")
        .lines()
        .find_map(|line| line.strip_prefix(&head))
        .expect("it is in the table");
    row.split(' ')
        .map(|word| f32::from_bits(u32::from_str_radix(word, 16).expect("it is hexadecimal")))
        .collect()
}

#[test]
fn noise_is_zero_drawn_or_given() {
    let image = shapes::denoise().image();
    assert_eq!(image.policy().noise_len(), 8);
    let drawn = normals(7);
    with_controller(&image, |controller| {
        let mut random = Random(4);
        assert_eq!(controller.noise(), Noise::Zero);
        let observation = small(&mut random);
        assert_eq!(
            step(controller, &observation).0,
            denoised(&observation, &[0.0; 8])
        );

        controller.set_noise(Noise::Seeded { seed: 7 });
        for noise in drawn.chunks_exact(8).take(2) {
            let observation = small(&mut random);
            // What is refused draws nothing.
            assert!(controller.step(&[f32::NAN; 2], &mut [0.0; 2]).is_err());
            assert_eq!(
                step(controller, &observation).0,
                denoised(&observation, noise)
            );
            // The stream continues over a reset.
            controller.reset();
        }
        for i in 0..3 {
            let (observation, noise) = (small(&mut random), random.vec(8, 1.0));
            let given = [
                (ChannelId(NOISE), Data::F32(&noise)),
                (ChannelId(0), Data::F32(&observation)),
            ];
            let mut action = [0.0; 2];
            controller
                .step_with(&given, &mut action)
                .expect("the step is sound");
            assert_eq!(action, denoised(&observation, &noise), "{i}");
        }
        // What was given used up nothing of the stream.
        let observation = small(&mut random);
        assert_eq!(
            step(controller, &observation).0,
            denoised(&observation, &drawn[16..24])
        );
        controller.set_noise(Noise::Seeded { seed: 7 });
        assert_eq!(
            step(controller, &observation).0,
            denoised(&observation, &drawn[..8])
        );
    });
}

#[test]
fn a_window_is_filled_with_zeros_or_the_first() {
    for fill in [Fill::Zero, Fill::First] {
        with_controller(&shapes::window(fill).image(), |controller| {
            let mut random = Random(6);
            let mut rows: Vec<[f32; 2]> = Vec::new();
            for i in 0..23 {
                if i == 11 || i == 13 {
                    controller.reset();
                    rows.clear();
                }
                let observation = small(&mut random);
                rows.push(observation);
                let row = |back: usize| match (rows.len().checked_sub(back), fill) {
                    (Some(at), _) => rows[at],
                    (None, Fill::First) => rows[0],
                    (None, Fill::Zero) => [0.0; 2],
                };
                let [oldest, middle, newest] = [3, 2, 1].map(row);
                let expected = [0, 1].map(|j| (oldest[j] * 0.5 + middle[j] * 0.25) + newest[j]);
                let (action, report) = step(controller, &observation);
                assert_eq!(action, clip(expected), "step {i}");
                let t = if i >= 13 { i - 13 } else { i % 11 };
                assert_eq!((report.timestep, report.selected), (t, None));
            }
        });
    }
}

#[test]
fn a_ring_is_read_row_by_row() {
    with_controller(&shapes::history().image(), |controller| {
        let mut random = Random(8);
        let (mut ring, mut low, mut previous) = (Vec::<Vec<f64>>::new(), Vec::new(), vec![0.0; 2]);
        for i in 0..20_usize {
            let t = i % 6;
            let observation = wide(&random.vec(2, 0.5));
            if t == 0 {
                ring.clear();
            }
            if t.is_multiple_of(2) {
                let code = CODES[best(&observation).1 as usize];
                low = vec![wide(&code)];
                for (pass, row) in ring.iter().enumerate() {
                    low.extend([row.clone(), wide(&STEPS[pass])]);
                }
            }
            let place = wide(&STEPS[t % 2]);
            low.extend([
                previous.clone(),
                vec![observation[0] + place[0], observation[1] + place[1]],
            ]);
            ring.push((0..2).map(|j| previous[j] + observation[j]).collect());
            if ring.len() > MEMORY as usize {
                ring.remove(0);
            }
            let (action, _) = step(controller, &[observation[0] as f32, observation[1] as f32]);
            near(&action, &attend(&low));
            previous = wide(&action);
        }
    });
}

#[test]
fn a_queue_is_read_by_phase() {
    with_controller(&shapes::queue().image(), |controller| {
        let mut random = Random(9);
        let mut filled = [0.0; 2];
        for i in 0..20_usize {
            let observation = random.vec(2, 1.0);
            if i.is_multiple_of(3) {
                filled = [observation[0], observation[1]];
            }
            let expected = [0, 1].map(|j| filled[j] * STEPS[i % 3][j]);
            assert_eq!(step(controller, &observation).0, clip(expected));
        }
    });
}

#[test]
fn plain_states_last_an_episode_or_an_instruction() {
    with_controller(&shapes::recurrent().image(), |controller| {
        let mut random = Random(10);
        for id in [0, 1, 1] {
            controller
                .set_instruction(Instruction::Id(id))
                .expect("it is known");
            let words = WORDS[id as usize];
            let goal = [0, 1].map(|j| words[j] + words.get(2 + j).copied().unwrap_or(0.0));
            let (mut count, mut hidden) = (0.0, [0.0; 2]);
            for i in 0..16 {
                // A reset after the seventh step; a context of five steps.
                let t = if i < 7 { i % 5 } else { (i - 7) % 5 };
                if i == 7 {
                    controller.reset();
                }
                if t == 0 {
                    hidden = [0.0; 2];
                }
                let observation = small(&mut random);
                hidden = [0, 1].map(|j| (hidden[j] * 0.5 + observation[j]) + goal[j]);
                count += 1.0;
                let (action, report) = step(controller, &observation);
                assert_eq!(
                    action,
                    clip(hidden.map(|h| h * 0.25 + count * 0.125)),
                    "step {i}"
                );
                assert_eq!(report.timestep, t);
            }
        }
    });
}

#[test]
fn a_policy_without_memory_and_instruction_goes_on_beyond_its_context() {
    with_controller(&shapes::memoryless().image(), |controller| {
        assert!(controller.is_instructed());
        assert_eq!(
            controller.set_instruction(Instruction::Id(0)),
            Err(InstructionError::NotTaken)
        );
        let mut random = Random(11);
        for i in 0..10_usize {
            let observation = small(&mut random);
            let (action, report) = step(controller, &observation);
            assert_eq!(
                action,
                clip([0, 1].map(|j| observation[j] + STEPS[i % 3][j]))
            );
            assert_eq!((report.timestep as usize, report.selected), (i % 3, None));
        }
        assert_eq!(
            (controller.scores().len(), controller.policy().state_len()),
            (0, 4)
        );
    });
}

#[test]
fn bytes_and_integers_are_read_as_numbers_and_slots() {
    let image = shapes::camera().image();
    with_controller(&image, |controller| {
        let mut random = Random(12);
        for i in 0..40_i32 {
            let observation = small(&mut random);
            let pixels = [i as u8 * 6, 255 - i as u8, 3, 77];
            let (gear, ticks) = ([i % 4], [i % 5 - 4, 4 - i % 3]);
            // In any order.
            let mut given = [
                (ChannelId(GEAR), Data::I32(&gear)),
                (ChannelId(shapes::CAMERA), Data::U8(&pixels)),
                (ChannelId(0), Data::F32(&observation)),
                (ChannelId(shapes::TICKS), Data::I32(&ticks)),
            ];
            given.rotate_left(i as usize % 4);
            let mut action = [0.0; 2];
            controller
                .step_with(&given, &mut action)
                .expect("the step is sound");
            let row = STEPS[gear[0] as usize];
            let expected = [0, 1].map(|j| {
                (observation[j] + row[j]) + (f32::from(pixels[j]) / 256.0 + ticks[j] as f32 * 0.125)
            });
            assert_eq!(action, clip(expected), "step {i}");
        }
        let refused = controller.step(&[0.0; 2], &mut [0.0; 2]);
        let missing = lads_core::InputError::Missing {
            channel: shapes::CAMERA,
        };
        assert_eq!(refused, Err(StepError::Input(missing)));
    });
}
