//! Tests of the C functions, called from Rust as C would call them: their results equal the
//! controller's.

use core::ffi::CStr;
use core::ptr::{null, null_mut};
use core::slice;

use crate::host::support::{Memory, Random};
use crate::host::*;
use lads_core::Instruction;
use lads_ffi::*;

#[test]
fn an_episode_through_c_is_the_controllers_episode() {
    let image = image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut expected = memory.controller(&policy);
    let mut host = Host::new(image.clone());
    let c = host.controller();
    let mut random = Random(6);
    let words = random.vec(8, 1.0);
    expected
        .set_instruction(Instruction::Words(&words))
        .expect("two words are enough");
    // SAFETY: the controller and the words are alive.
    let status = unsafe { lads_set_words(c, words.as_ptr(), words.len(), null_mut()) };
    assert_eq!(status, Status::Ok);
    for t in 0..30 {
        if t == 10 {
            expected
                .set_instruction(Instruction::Id(1))
                .expect("the instruction is known");
            instruct(c, 1);
        }
        if t == 20 {
            expected.reset();
            // SAFETY: the controller is alive.
            let status = unsafe { lads_reset(c) };
            assert_eq!(status, Status::Ok);
        }
        let observation = random.vec(3, 1.0);
        let (mut action, mut other) = ([0.0; 2], [0.0; 2]);
        let made = expected
            .step(&observation, &mut other)
            .expect("the step is sound");
        let (status, report) = step(c, &observation, &mut action);
        assert_eq!((status, report.status, report.stepped), (Status::Ok, 0, 1));
        assert_eq!(action, other);
        let selected = made.selected.expect("the policy selects");
        assert_eq!(
            (report.timestep, report.selected, report.margin),
            (made.timestep, selected.index, selected.margin)
        );
        assert_eq!(
            (report.has_selected, report.fresh == 1),
            (1, selected.fresh)
        );
        assert_eq!((report.channel, report.element), (LADS_NONE, LADS_NONE));
        let executed = random.vec(2, 1.0);
        expected.executed(&executed).expect("the action is sound");
        // SAFETY: the controller and the action are alive.
        let status = unsafe { lads_executed(c, executed.as_ptr(), 2, null_mut()) };
        assert_eq!(status, Status::Ok);
    }
}

#[test]
fn the_contract_is_the_policys() {
    let image = image();
    let expected = image.policy();
    let contract = expected.contract();
    let host = Host::new(image.clone());
    let policy = &raw const *host.policy;
    // SAFETY: the policy is open, in all of these.
    let c = written(|to| unsafe { lads_policy_contract(policy, to) }).expect("it is open");
    assert_eq!((c.observation_len, c.action_len), (3, 2));
    assert_eq!((c.index_count, c.context_steps), (5, 8));
    assert_eq!((c.beyond, c.noise_len), (LADS_BEYOND_RESTART, 0));
    assert_eq!((c.temperature, c.noise), (0.0, LADS_NOISE_ZERO));
    assert_eq!((c.words_len, c.word_dim, c.instruction_count), (4, 4, 2));
    assert_eq!(
        (c.control_period_s, c.image_bytes),
        (0.08, image.bytes().len())
    );
    assert_eq!(
        (c.acceptance, c.worst_work),
        (contract.acceptance(), contract.worst_work())
    );
    assert_eq!(c.observation_count, 1);
    assert_eq!(c.observation, contract.observation().id().0);
    assert_eq!(c.action, contract.action().id().0);
    assert_ne!(c.instruction, LADS_NONE);
    // SAFETY: all texts point into the image.
    unsafe {
        assert_eq!(c.family.as_str(), contract.family());
        assert_eq!(c.environment.as_str(), contract.environment_id());
        assert_eq!(
            c.environment_version.as_str(),
            contract.environment_version()
        );
        assert_eq!(c.bundle_sha256.as_str(), contract.bundle_sha256());
        assert_eq!(c.encoder.as_str(), contract.encoder());
        assert_eq!(c.encoder_sha256.as_str(), contract.encoder_sha256());
        assert_eq!(lads_channel_count(policy), c.channel_count);
        assert_eq!(lads_channel_count(null()), 0);
        assert_eq!(c.channel_count as usize, contract.channels().count());
        let by_name = |name: &str| {
            let (data, len) = (name.as_ptr().cast(), name.len());
            written(|to| lads_channel_find(policy, data, len, to))
        };
        for (number, expected) in (0..).zip(contract.channels()) {
            let got = written(|to| lads_channel(policy, number, to)).expect("it is there");
            assert_eq!(got.name.as_str(), expected.name());
            assert_eq!(got.reference.as_str(), expected.reference());
            assert_eq!(got.len, expected.len());
            assert_eq!(&got.dims[..got.rank as usize], expected.shape());
            assert_eq!(by_name(expected.name()), Ok(number));
            let mut elements = 0;
            for (i, element) in expected.elements().enumerate() {
                let got = written(|to| lads_channel_element(policy, number, i, to));
                let got = got.expect("it is there");
                let texts = [
                    got.name,
                    got.unit,
                    got.joint,
                    got.interface,
                    got.physical_unit,
                ];
                let texts = texts.map(|t| t.as_str());
                let theirs = [
                    element.name,
                    element.unit,
                    element.joint,
                    element.interface,
                    element.physical_unit,
                ];
                assert_eq!(texts, theirs);
                assert_eq!([got.min, got.max], [element.limits.min, element.limits.max]);
                assert_eq!([got.scale, got.offset], [element.scale, element.offset]);
                elements += 1;
            }
            assert_eq!(got.described == 1, elements == got.len);
            let beyond = written(|to| lads_channel_element(policy, number, got.len, to)).err();
            assert_eq!(beyond, Some(Status::NoElement));
        }
        assert_eq!(by_name("no such channel"), Err(Status::NoChannel));
        let beyond = written(|to| lads_channel(policy, c.channel_count, to)).err();
        assert_eq!(beyond, Some(Status::NoChannel));
        let beyond = written(|to| lads_channel_element(policy, LADS_NONE, 0, to)).err();
        assert_eq!(beyond, Some(Status::NoChannel));
        for (number, known) in (0..).zip(contract.instructions()) {
            let got =
                written(|to| lads_policy_instruction(policy, number, to)).expect("it is known");
            let texts = [got.id, got.text].map(|t| t.as_str());
            assert_eq!(texts, [known.id, known.text]);
            assert_eq!(got.words_len * c.word_dim, known.words.len());
            let by_name = |name: &str| {
                let (data, len) = (name.as_ptr().cast(), name.len());
                written(|to| lads_policy_find_instruction(policy, data, len, to))
            };
            assert_eq!(by_name(known.id), Ok(number));
            assert!(by_name(known.text).is_ok());
            assert_eq!(by_name("make tea"), Err(Status::UnknownInstruction));
        }
        let beyond = written(|to| lads_policy_instruction(policy, 2, to)).err();
        assert_eq!(beyond, Some(Status::UnknownInstruction));
    }
}

#[test]
fn the_self_test_arms_or_does_not() {
    let mut host = Host::new(image());
    let (status, c) = host.init(&LadsOptions::default());
    assert_eq!(status, Status::Ok);
    instruct(c, 0);
    let mut action = [7.0; 2];
    assert_eq!(step(c, &[0.0; 3], &mut action).0, Status::NotArmed);
    assert_eq!(action, [0.0; 2]);
    let mut result = LadsSelfTest::default();
    // SAFETY: the controller and the result are alive.
    unsafe {
        assert_eq!(lads_self_test(c, &raw mut result), Status::Ok);
        assert_eq!(lads_self_test(c, null_mut()), Status::Ok);
    }
    assert_eq!((result.steps, result.largest_error), (12, 0.0));
    assert_ne!(result.digest, 0);
    assert_eq!(step(c, &[0.0; 3], &mut action).0, Status::NoInstruction);
    instruct(c, 0);
    assert_eq!(step(c, &[0.0; 3], &mut action).0, Status::Ok);

    let mut parts = lads(11);
    let episode = parts.golden.as_mut().expect("there is one");
    episode.actions[3] += 0.5;
    let mut host = Host::new(parts.image());
    let c = host.controller();
    // SAFETY: the controller and the result are alive.
    let status = unsafe { lads_self_test(c, &raw mut result) };
    assert_eq!(status, Status::SelfTestAction);
    assert_eq!(
        (result.failed_step, result.element, result.steps),
        (1, 1, 0)
    );
    assert!(
        (result.expected - result.got - 0.5).abs() < 1e-6,
        "{result:?}"
    );
    instruct(c, 0);
    assert_eq!(step(c, &[0.0; 3], &mut action).0, Status::NotArmed);
    parts.golden = None;
    let mut host = Host::new(parts.image());
    // SAFETY: the controller is alive.
    let status = unsafe { lads_self_test(host.controller(), null_mut()) };
    assert_eq!(status, Status::NoGolden);
}

#[test]
fn a_wrong_observation_gets_the_fallback_and_its_reason() {
    let mut host = Host::new(image());
    let c = host.controller();
    let mut action = [7.0; 2];
    assert_eq!(step(c, &[0.0; 3], &mut action).0, Status::NoInstruction);
    assert_eq!(action, [0.0; 2]);
    instruct(c, 0);
    let observation = [0.3, -0.2, 0.7];
    assert_eq!(step(c, &observation, &mut action).0, Status::Ok);
    let last = action;
    let mut wrong = |observation: &[f32], expected| {
        action = [f32::NAN; 2];
        let (status, report) = step(c, observation, &mut action);
        assert_eq!((status, report.status), (expected, expected as i32));
        assert_eq!((action, report.stepped), (last, 0));
        assert_eq!(report.channel, 0);
        (report.element, report.value, report.min, report.max)
    };
    let nothing = (LADS_NONE, 0.0, 0.0, 0.0);
    assert_eq!(wrong(&[0.0; 2], Status::ObservationLength), nothing);
    assert_eq!(wrong(&[], Status::ObservationLength), nothing);
    let not_finite = wrong(&[0.0, f32::NAN, 0.0], Status::NotFinite);
    assert_eq!(not_finite, (1, 0.0, 0.0, 0.0));
    let outside = wrong(&[0.0, 0.0, 4.0], Status::OutOfLimits);
    assert_eq!(outside, (2, 4.0, -3.0, 3.0));
    // SAFETY: the controller and both arrays are alive; what overlaps is refused.
    unsafe {
        let to = action.as_mut_ptr();
        let status = lads_step(c, null(), 3, null(), to, 2, null_mut());
        assert_eq!((status, action), (Status::NoObservation, last));
        let odd = observation.as_ptr().wrapping_byte_add(1);
        let status = lads_step(c, odd, 3, null(), to, 2, null_mut());
        assert_eq!((status, action), (Status::Misaligned, last));
        let inside = c.cast::<f32>().wrapping_add(64);
        let status = lads_step(c, inside, 3, null(), to, 2, null_mut());
        assert_eq!((status, action), (Status::Overlap, last));
        let mut both = observation;
        let both = both.as_mut_ptr();
        let status = lads_step(c, both, 3, null(), both, 2, null_mut());
        assert_eq!(status, Status::Overlap);
        assert_eq!(slice::from_raw_parts(both, 2), last);
        let mut tick = LadsTick {
            timestamp: 5,
            ..LadsTick::default()
        };
        let tick = &raw mut tick;
        let status = lads_step(c, observation.as_ptr(), 3, tick, to, 2, null_mut());
        assert_eq!(status, Status::Ok);
        let status = lads_step(c, observation.as_ptr(), 3, tick, to, 2, null_mut());
        assert_eq!(status, Status::Stale);
        (*tick).timestamp = 6;
        (*tick).missed = 1;
        let status = lads_step(c, observation.as_ptr(), 3, tick, to, 2, null_mut());
        assert_eq!(status, Status::Late);
    }
    let expected = LadsCounters {
        periods: 13,
        policy: 2,
        no_observation: 4,
        stale: 1,
        late: 1,
        not_finite: 1,
        out_of_limits: 1,
        refused: 3,
        missed: 1,
        saturated: counters(c).saturated,
        ..LadsCounters::default()
    };
    assert_eq!(counters(c), expected);
}

#[test]
fn warming_up_changes_nothing() {
    let run = |warm: bool| {
        let mut host = Host::new(image());
        let c = host.controller();
        instruct(c, 0);
        let mut bits = vec![];
        for number in 0..12 {
            if warm {
                // SAFETY: the controller is alive.
                assert_eq!(unsafe { lads_warm(c) }, Status::Ok);
            }
            let mut action = [7.0_f32; 2];
            let (status, report) = step(c, &[0.1 * number as f32; 3], &mut action);
            assert_eq!(status, Status::Ok);
            bits.push((action.map(f32::to_bits), report.selected));
        }
        (bits, counters(c).periods)
    };
    assert_eq!(run(true), run(false));
}

#[test]
fn a_stop_lasts_until_it_is_resumed() {
    let mut host = Host::new(image());
    let c = host.controller();
    instruct(c, 0);
    let mut action = [7.0; 2];
    // SAFETY: the controller is alive.
    unsafe {
        assert_eq!(lads_stop(c), Status::Ok);
        assert_eq!(lads_reset(c), Status::Ok);
        assert_eq!(step(c, &[0.0; 3], &mut action).0, Status::Stopped);
        assert_eq!(action, [0.0; 2]);
        assert_eq!(lads_resume(c), Status::Ok);
    }
    assert_eq!(step(c, &[0.0; 3], &mut action).0, Status::Ok);
}

#[test]
fn portable_instructions_give_the_same_bits() {
    let run = |flags: u32| {
        let mut host = Host::new(image());
        let flags = flags | LADS_ARM_WITHOUT_SELF_TEST;
        let (status, c) = host.init(&LadsOptions {
            flags,
            ..LadsOptions::default()
        });
        assert_eq!(status, Status::Ok);
        instruct(c, 1);
        let mut random = Random(3);
        let mut actions = Vec::new();
        for _ in 0..20 {
            let mut action = [0.0; 2];
            assert_eq!(step(c, &random.vec(3, 2.0), &mut action).0, Status::Ok);
            actions.extend(action.map(f32::to_bits));
        }
        actions
    };
    assert_eq!(run(0), run(LADS_PORTABLE_INSTRUCTIONS));
}

#[test]
fn two_controllers_of_one_policy_run_in_two_threads() {
    let image = image();
    let policy = open(image.bytes()).expect("the image is sound");
    // Threads take addresses, as C would pass them.
    let address = (&raw const *policy).expose_provenance();
    let run = move |seed: u64| {
        let policy = core::ptr::with_exposed_provenance(address);
        // SAFETY: the policy outlives the threads, which only read it.
        let bytes = unsafe { lads_workspace_bytes(policy) };
        let mut workspace = vec![Line([0; LINE]); bytes / LINE];
        let options = LadsOptions {
            flags: LADS_ARM_WITHOUT_SELF_TEST,
            ..LadsOptions::default()
        };
        let memory = workspace.as_mut_ptr().cast();
        let mut c = null_mut();
        let (options, to) = (&raw const options, &raw mut c);
        // SAFETY: as above; the workspace is this thread's own.
        let status =
            unsafe { lads_controller_init(policy, memory, bytes, options, to, null_mut()) };
        assert_eq!(status, Status::Ok);
        instruct(c, (seed % 2) as u32);
        let mut random = Random(seed);
        let mut actions = Vec::new();
        for _ in 0..500 {
            let mut action = [0.0; 2];
            assert_eq!(step(c, &random.vec(3, 1.0), &mut action).0, Status::Ok);
            actions.extend(action.map(f32::to_bits));
        }
        actions
    };
    let alone = [run(1), run(2)];
    let together = [1, 2].map(|seed| std::thread::spawn(move || run(seed)));
    let together = together.map(|thread| thread.join().expect("no thread panics"));
    assert_eq!(alone, together);
}

#[test]
fn sampling_follows_the_seed() {
    let picked = |temperature: f32, seed: u64| {
        let mut host = Host::new(image());
        let c = host.controller();
        // SAFETY: the controller is alive.
        let status = unsafe { lads_set_decision(c, temperature, seed) };
        assert_eq!(status, Status::Ok);
        instruct(c, 0);
        let pick = |_| {
            let (status, report) = step(c, &[0.1; 3], &mut [0.0; 2]);
            assert_eq!(status, Status::Ok);
            report.selected
        };
        (0..60).map(pick).collect::<Vec<_>>()
    };
    assert_eq!(picked(3.0, 1), picked(3.0, 1));
    assert_ne!(picked(3.0, 1), picked(3.0, 2));
    assert_eq!(picked(0.0, 1), picked(0.0, 2));
    assert_eq!(picked(f32::NAN, 1), picked(0.0, 2));
}

#[test]
fn every_status_has_a_number_and_a_text_of_its_own() {
    let text = |status| {
        // SAFETY: the text is a static string that ends in zero.
        let text = unsafe { CStr::from_ptr(lads_status_text(status)) };
        text.to_str().expect("the text is ASCII")
    };
    assert_eq!(
        (text(0), text(999), text(-1)),
        ("ok", "unknown status", "unknown status")
    );
    assert!(Status::ALL.is_sorted_by_key(|(status, _)| *status as i32));
    let mut texts: Vec<_> = Status::ALL
        .iter()
        .map(|&(status, _)| text(status as i32))
        .collect();
    assert!(texts.iter().all(|text| *text != "unknown status"));
    texts.sort_unstable();
    texts.dedup();
    assert_eq!(texts.len(), Status::ALL.len());
}
