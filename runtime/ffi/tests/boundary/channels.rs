//! Tests of policies with any channels through C: images, integers, noise, no instruction, chunks
//! without a selection.

use core::ptr::null_mut;

use crate::host::support::shapes::{self, CAMERA, GEAR, NOISE, TICKS};
use crate::host::support::{Memory, Random, Values, given, observe};
use crate::host::*;
use lads_ffi::*;

fn inputs(values: &[(lads_core::ChannelId, Values)]) -> Vec<LadsInput> {
    values
        .iter()
        .map(|(id, values)| input(id.0, values))
        .collect()
}

#[test]
fn every_shape_of_policy_steps_through_c_as_in_rust() {
    for (name, parts) in shapes::all() {
        let image = parts.image();
        let policy = image.policy();
        let mut memory = Memory::for_policy(&policy);
        let mut expected = memory.controller(&policy);
        let mut host = Host::new(image.clone());
        let c = host.controller();
        let takes = policy.contract().instruction_count() > 0;
        if takes {
            expected
                .set_instruction(lads_core::Instruction::Id(0))
                .expect("it is known");
            instruct(c, 0);
        } else {
            // SAFETY: the controller is alive.
            let status = unsafe { lads_set_instruction(c, 0) };
            assert_eq!(status, Status::NoInstructionTaken, "{name}");
        }
        let mut random = Random(3);
        for t in 0..12 {
            let values = observe(&policy, &mut random);
            let (mut action, mut other) = ([7.0; 2], [0.0; 2]);
            let made = expected
                .step_with(&given(&values), &mut other)
                .expect("it is sound");
            let (status, report) = step_channels(c, &inputs(&values), &mut action);
            assert_eq!((status, action), (Status::Ok, other), "{name}, step {t}");
            let selected = made.selected.map(|selected| selected.index);
            let got = (report.has_selected == 1).then_some(report.selected);
            assert_eq!(got, selected, "{name}");
            assert_eq!(report.timestep, made.timestep, "{name}");
        }
    }
}

#[test]
fn a_camera_is_described_and_checked() {
    let image = shapes::camera().image();
    let mut host = Host::new(image.clone());
    let policy = &raw const *host.policy;
    // SAFETY: the policy is open.
    let (contract, camera, pixel) = unsafe {
        (
            written(|to| lads_policy_contract(policy, to)).expect("it is open"),
            written(|to| lads_channel(policy, CAMERA, to)).expect("it is there"),
            written(|to| lads_channel_element(policy, CAMERA, 3, to)).expect("it is there"),
        )
    };
    assert_eq!(
        (contract.observation_count, contract.instruction),
        (4, LADS_NONE)
    );
    assert_eq!((contract.index_count, contract.words_len), (0, 0));
    assert_eq!(
        (camera.role, camera.dtype),
        (LADS_ROLE_OBSERVATION, LADS_U8)
    );
    assert_eq!(
        (camera.rank, camera.dims, camera.described),
        (3, [2, 2, 1, 1], 0)
    );
    assert_eq!((pixel.min, pixel.max, pixel.name.len), (0.0, 255.0, 0));

    let c = host.controller();
    let values = observe(&image.policy(), &mut Random(1));
    let good = inputs(&values);
    let at = |channel: u32| {
        let found = good.iter().position(|input| input.channel == channel);
        found.expect("it is an observation")
    };
    let mut action = [7.0; 2];
    let mut wrong = |list: &[LadsInput]| {
        let (status, report) = step_channels(c, list, &mut action);
        assert_eq!(report.status, status as i32);
        (status, report.channel, report.element)
    };
    let changed = |channel: u32, change: &dyn Fn(&mut LadsInput)| {
        let mut list = good.clone();
        change(&mut list[at(channel)]);
        list
    };
    let rows = |bytes| changed(CAMERA, &|input| input.row_bytes = bytes);
    assert_eq!(wrong(&good).0, Status::Ok);
    assert_eq!(wrong(&rows(2)).0, Status::Ok);
    assert_eq!(wrong(&rows(16)), (Status::ChannelRows, CAMERA, LADS_NONE));
    assert_eq!(wrong(&rows(1)), (Status::ChannelRows, CAMERA, LADS_NONE));
    let floats = changed(CAMERA, &|input| (input.dtype, input.len) = (LADS_F32, 1));
    assert_eq!(
        wrong(&floats),
        (Status::ObservationLength, CAMERA, LADS_NONE)
    );
    let unknown = changed(GEAR, &|input| input.dtype = 9);
    assert_eq!(wrong(&unknown), (Status::ChannelType, GEAR, LADS_NONE));
    let bytes = [0_u8; 8];
    let bytes = changed(TICKS, &|input| {
        (input.dtype, input.data) = (LADS_U8, bytes.as_ptr().cast());
    });
    assert_eq!(wrong(&bytes), (Status::ChannelType, TICKS, LADS_NONE));
    let outside = [0, 5];
    let outside = changed(TICKS, &|input| input.data = outside.as_ptr().cast());
    assert_eq!(wrong(&outside), (Status::OutOfLimits, TICKS, 1));
    let odd = changed(TICKS, &|input| input.data = input.data.wrapping_byte_add(1));
    assert_eq!(wrong(&odd), (Status::Misaligned, TICKS, LADS_NONE));
    let null = changed(CAMERA, &|input| input.data = core::ptr::null());
    assert_eq!(wrong(&null).0, Status::NoObservation);
    let other = changed(GEAR, &|input| input.channel = 77);
    assert_eq!(wrong(&other), (Status::ChannelUnknown, 77, LADS_NONE));
    assert_eq!(
        wrong(&good[1..]),
        (Status::ChannelMissing, good[0].channel, LADS_NONE)
    );
    let twice: Vec<_> = good.iter().chain(&good).copied().collect();
    assert_eq!(wrong(&twice).0, Status::ChannelUnknown);
    let many: Vec<_> = core::iter::repeat_n(good[0], 40).collect();
    assert_eq!(wrong(&many).0, Status::ChannelUnknown);
    // A single vector is not all that this policy sees.
    assert_eq!(step(c, &[0.0; 2], &mut action).0, Status::ChannelMissing);
}

/// Tests that a camera that sends nothing, the same frame again or a bad one leaves everything as a period without a frame does: the
/// fallback acts, and the next frame is judged as if only time had passed.
#[test]
fn a_frame_that_cannot_be_used_is_as_no_frame() {
    let image = shapes::camera().image();
    let mut random = Random(4);
    let [first, next] = [(); 2].map(|()| observe(&image.policy(), &mut random));
    let [first, next] = [inputs(&first), inputs(&next)];
    let with = |change: fn(&mut LadsInput)| {
        let mut list = next.clone();
        let camera = list.iter_mut().find(|input| input.channel == CAMERA);
        change(camera.expect("it is an observation"));
        list
    };
    let stride = with(|input| input.row_bytes = 64);
    let short = with(|input| input.len -= 1);
    let layout = with(|input| input.dtype = 9);
    let run = |bad: [(&[LadsInput], u64); 5]| {
        let mut host = Host::new(image.clone());
        let c = host.controller();
        let step = |list: &[LadsInput], timestamp: u64| {
            let tick = LadsTick {
                timestamp,
                ..LadsTick::default()
            };
            let (mut action, mut report) = ([7.0_f32; 2], LadsReport::default());
            let (data, to) = (list.as_ptr(), action.as_mut_ptr());
            let data = if list.is_empty() {
                core::ptr::null()
            } else {
                data
            };
            let tick = &raw const tick;
            // SAFETY: all of it is alive.
            let status =
                unsafe { lads_step_channels(c, data, list.len(), tick, to, 2, &raw mut report) };
            (status, action)
        };
        let before = step(&first, 10);
        let refused = bad.map(|(list, timestamp)| step(list, timestamp));
        (before, refused, step(&next, 20))
    };
    let none: (&[LadsInput], u64) = (&[], 10);
    let (before, blind, after) = run([none; 5]);
    assert_eq!((before.0, after.0), (Status::Ok, Status::Ok));
    assert!(
        blind
            .iter()
            .all(|&(status, _)| status == Status::NoObservation)
    );
    let bad = [
        none,
        (&first[..], 10),
        (&stride[..], 11),
        (&short[..], 12),
        (&layout[..], 13),
    ];
    let (_, refused, again) = run(bad);
    assert_eq!(
        refused.map(|(status, _)| status),
        [
            Status::NoObservation,
            Status::Stale,
            Status::ChannelRows,
            Status::ObservationLength,
            Status::ChannelType
        ]
    );
    assert_eq!(refused.map(|it| it.1), blind.map(|it| it.1));
    assert_eq!(again, after);
}

#[test]
fn values_over_the_action_are_refused() {
    let image = shapes::camera().image();
    let mut host = Host::new(image.clone());
    let c = host.controller();
    let values = observe(&image.policy(), &mut Random(1));
    let mut list = inputs(&values);
    let mut action = [7.0_f32; 2];
    list[1].data = action.as_mut_ptr().cast();
    assert_eq!(step_channels(c, &list, &mut action).0, Status::Overlap);
    assert_eq!(action, [0.0; 2]);
    list[1].data = c.cast_const().cast();
    assert_eq!(step_channels(c, &list, &mut action).0, Status::Overlap);
}

#[test]
fn noise_is_drawn_or_given() {
    let image = shapes::denoise().image();
    let policy = image.policy();
    let run = |rule: u32, seed: u64, noise: Option<&[f32]>| {
        let mut host = Host::new(image.clone());
        let c = host.controller();
        // SAFETY: the controller is alive.
        let status = unsafe { lads_set_noise(c, rule, seed) };
        assert_eq!(status, Status::Ok);
        let values = observe(&policy, &mut Random(5));
        let mut list = inputs(&values);
        let noise = noise.map(|noise| Values::F32(noise.to_vec()));
        list.extend(noise.iter().map(|values| input(NOISE, values)));
        let mut action = [7.0; 2];
        assert_eq!(step_channels(c, &list, &mut action).0, Status::Ok);
        action
    };
    let zero = run(LADS_NOISE_ZERO, 0, None);
    let seeded = run(LADS_NOISE_SEEDED, 7, None);
    assert_eq!(seeded, run(LADS_NOISE_SEEDED, 7, None));
    assert_ne!(seeded, run(LADS_NOISE_SEEDED, 8, None));
    assert_ne!(seeded, zero);
    let zeros = vec![0.0; policy.noise_len()];
    assert_eq!(run(LADS_NOISE_SEEDED, 7, Some(&zeros)), zero);
    let mut host = Host::new(image.clone());
    // SAFETY: the controller is alive.
    let status = unsafe { lads_set_noise(host.controller(), 2, 0) };
    assert_eq!(status, Status::UnknownOption);
}

#[test]
fn a_full_context_is_readable_and_refuses() {
    let mut parts = shapes::memoryless();
    parts.contract.beyond = lads_image::records::Beyond::Refuse;
    let mut host = Host::new(parts.image());
    let policy = &raw const *host.policy;
    // SAFETY: the policy is open.
    let contract = written(|to| unsafe { lads_policy_contract(policy, to) }).expect("it is open");
    assert_eq!(
        (contract.context_steps, contract.beyond),
        (3, LADS_BEYOND_REFUSE)
    );
    let c = host.controller();
    let mut action = [0.0; 2];
    let statuses = [0; 4].map(|_| step(c, &[0.1; 2], &mut action).0);
    assert_eq!(
        statuses,
        [Status::Ok, Status::Ok, Status::Ok, Status::ContextFull]
    );
}

#[test]
fn coasting_and_jumps_are_options() {
    let mut host = Host::new(image());
    let (status, c) = host.init(&LadsOptions {
        flags: LADS_ARM_WITHOUT_SELF_TEST,
        coast: 2,
        max_jump: 100,
        ..LadsOptions::default()
    });
    assert_eq!(status, Status::Ok);
    instruct(c, 0);
    let mut report = LadsReport::default();
    let mut tick = LadsTick {
        timestamp: 10,
        ..LadsTick::default()
    };
    let (mut action, observation) = ([0.0_f32; 2], [0.4_f32; 3]);
    let mut at = |timestamp: u64| {
        tick.timestamp = timestamp;
        let (o, a) = (observation.as_ptr(), action.as_mut_ptr());
        // SAFETY: all of it is alive.
        let status = unsafe { lads_step(c, o, 3, &raw const tick, a, 2, &raw mut report) };
        (status, report.coasting, action)
    };
    assert_eq!(at(5).0, Status::Ok);
    let (status, coasting, last) = at(10);
    assert_eq!((status, coasting), (Status::Ok, 0));
    assert_eq!(at(u64::MAX), (Status::Jump, 1, last));
    let (status, coasting, last) = at(20);
    assert_eq!((status, coasting), (Status::Ok, 0));
    assert_eq!(at(20), (Status::Stale, 1, last));
    assert_eq!(at(20), (Status::Stale, 1, last));
    let (status, coasting, safe) = at(20);
    assert_eq!((status, coasting, safe), (Status::Stale, 0, [0.0; 2]));
    assert_eq!(counters(c).coasted, 3);
}

#[test]
fn a_sentence_is_compared_with_what_is_known() {
    let image = image();
    let host = Host::new(image.clone());
    let policy = &raw const *host.policy;
    let known = image
        .policy()
        .contract()
        .instruction(1)
        .expect("there are two")
        .words;
    let nearest = |words: &[f32]| {
        let (mut number, mut alike) = (LADS_NONE, 7.0);
        let (data, len) = (words.as_ptr(), words.len());
        let (number_at, alike_at) = (&raw mut number, &raw mut alike);
        // SAFETY: the policy is open, and the rest is alive.
        let status = unsafe { lads_instruction_similarity(policy, data, len, number_at, alike_at) };
        (status, number, alike)
    };
    let (status, number, alike) = nearest(known);
    assert_eq!((status, number), (Status::Ok, 1));
    assert!((alike - 1.0).abs() < 1e-5, "{alike}");
    let opposite: Vec<f32> = known.iter().map(|x| -x).collect();
    assert!(nearest(&opposite).2 < 0.9);
    assert_eq!(nearest(&known[1..]).0, Status::WordsLength);
    assert_eq!(nearest(&[]).0, Status::WordsLength);
    assert_eq!(nearest(&[f32::NAN; 4]).0, Status::WordsNotFinite);
    let none = Host::new(shapes::camera().image());
    let mut alike = 0.0_f32;
    // SAFETY: as above.
    let status = unsafe {
        let policy = &raw const *none.policy;
        lads_instruction_similarity(policy, known.as_ptr(), 4, null_mut(), &raw mut alike)
    };
    assert_eq!(status, Status::NoInstructionTaken);
}
