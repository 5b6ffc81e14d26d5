//! The C functions, called from Rust as C would call them: the same results as the controller, and every wrong pointer, length,
//! image or order of calls refused with its number.

#[path = "../../core/tests/support/mod.rs"]
mod support;

use core::ffi::{CStr, c_void};
use core::mem::MaybeUninit;
use core::ptr::{null, null_mut};
use core::slice;

use lads_core::Instruction;
use lads_ffi::*;
use support::assemble::{parts, with_golden};
use support::{Image, Memory, Model, Random, Spec};

fn image() -> Image {
    with_golden(parts(&Model::random(Spec::TINY, 11)), 12).image()
}

const LINE: usize = LADS_WORKSPACE_ALIGN;

/// A cache line.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Line([u8; LINE]);

/// Everything that a C program would allocate for one controller.
struct Host {
    image: Image,
    policy: Box<LadsPolicy>,
    workspace: Vec<Line>,
}

/// An opened policy, or why not.
fn open(bytes: &[u8]) -> Result<Box<LadsPolicy>, Status> {
    let mut policy = Box::new(LadsPolicy {
        private_words: [u64::MAX; LADS_POLICY_WORDS],
    });
    // SAFETY: the image and the policy are alive.
    match unsafe { lads_policy_open(bytes.as_ptr(), bytes.len(), &raw mut *policy) } {
        Status::Ok => Ok(policy),
        status => Err(status),
    }
}

impl Host {
    fn new(image: Image) -> Self {
        let policy = open(image.bytes()).expect("the image is sound");
        // SAFETY: the policy is open.
        let bytes = unsafe { lads_workspace_bytes(&raw const *policy) };
        assert!(bytes.is_multiple_of(LINE));
        Self {
            image,
            policy,
            workspace: vec![Line([0xff; LINE]); bytes / LINE],
        }
    }

    fn bytes(&self) -> usize {
        self.workspace.len() * LINE
    }

    fn memory(&mut self) -> *mut c_void {
        self.workspace.as_mut_ptr().cast()
    }

    fn init(&mut self, options: &LadsOptions) -> (Status, *mut LadsController) {
        let (memory, bytes, mut made) = (self.memory(), self.bytes(), null_mut());
        // SAFETY: all of it is alive; the tests' lists are as long as an action.
        let status = unsafe {
            lads_controller_init(
                &raw const *self.policy,
                memory,
                bytes,
                options,
                &raw mut made,
            )
        };
        (status, made)
    }

    /// A controller that nobody has tested.
    fn controller(&mut self) -> *mut LadsController {
        let (status, made) = self.init(&LadsOptions {
            flags: LADS_ARM_WITHOUT_SELF_TEST,
            fallback: LADS_FALLBACK_HOLD,
            ..LadsOptions::default()
        });
        assert_eq!(status, Status::Ok);
        assert_eq!(made.cast(), self.memory());
        made
    }
}

fn step(
    controller: *mut LadsController,
    observation: &[f32],
    action: &mut [f32],
) -> (Status, LadsReport) {
    let mut report = LadsReport::default();
    let (o, a) = (observation.len(), action.len());
    // SAFETY: the slices are alive, and each test passes a controller of a host that is alive, or null.
    let status = unsafe {
        lads_step(
            controller,
            observation.as_ptr(),
            o,
            null(),
            action.as_mut_ptr(),
            a,
            &raw mut report,
        )
    };
    (status, report)
}

fn instruct(controller: *mut LadsController, number: u32) {
    // SAFETY: the controller is alive.
    let status = unsafe { lads_set_instruction(controller, number) };
    assert_eq!(status, Status::Ok);
}

fn counters(controller: *mut LadsController) -> LadsCounters {
    let mut counters = LadsCounters::default();
    // SAFETY: the controller is alive.
    let status = unsafe { lads_counters(controller, &raw mut counters) };
    assert_eq!(status, Status::Ok);
    counters
}

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
    let status = unsafe { lads_set_words(c, words.as_ptr(), words.len()) };
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
        assert_eq!(
            (report.timestep, report.plan, report.margin),
            (made.timestep, made.plan.0, made.margin)
        );
        assert_eq!(report.decided == 1, made.decided);
        let executed = random.vec(2, 1.0);
        expected.executed(&executed).expect("the action is sound");
        // SAFETY: the controller and the action are alive.
        let status = unsafe { lads_executed(c, executed.as_ptr(), 2) };
        assert_eq!(status, Status::Ok);
    }
}

/// What is written through a pointer by a function that returns a status.
fn written<T>(f: impl FnOnce(*mut T) -> Status) -> Result<T, Status> {
    let mut value = MaybeUninit::uninit();
    match f(value.as_mut_ptr()) {
        // SAFETY: the functions write what they return `Ok` for.
        Status::Ok => Ok(unsafe { value.assume_init() }),
        status => Err(status),
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
    assert_eq!((c.horizon, c.codebook_len, c.context_steps), (3, 5, 8));
    assert_eq!((c.words_len, c.word_dim, c.instruction_count), (4, 4, 2));
    assert_eq!(
        (c.control_period_s, c.image_bytes),
        (0.08, image.bytes().len())
    );
    // SAFETY: all texts point into the image.
    unsafe {
        assert_eq!(c.environment.as_str(), contract.environment_id());
        assert_eq!(
            c.environment_version.as_str(),
            contract.environment_version()
        );
        assert_eq!(c.bundle_sha256.as_str(), contract.bundle_sha256());
        assert_eq!(c.encoder.as_str(), contract.encoder());
        assert_eq!(c.encoder_sha256.as_str(), contract.encoder_sha256());
        let same = |a: LadsElement, b: lads_core::Element| {
            assert_eq!(
                [a.name, a.unit, a.joint].map(|t| t.as_str()),
                [b.name, b.unit, b.joint]
            );
            assert_eq!([a.min, a.max], [b.limits.min, b.limits.max]);
        };
        for (i, element) in contract.observations().enumerate() {
            same(
                written(|to| lads_policy_observation(policy, i, to)).expect("it is there"),
                element,
            );
        }
        for (i, element) in contract.actions().enumerate() {
            same(
                written(|to| lads_policy_action(policy, i, to)).expect("it is there"),
                element,
            );
        }
        let beyond = written(|to| lads_policy_observation(policy, 3, to)).err();
        assert_eq!(beyond, Some(Status::NoElement));
        let beyond = written(|to| lads_policy_action(policy, usize::MAX, to)).err();
        assert_eq!(beyond, Some(Status::NoElement));
        for (number, known) in (0..).zip(contract.instructions()) {
            let got =
                written(|to| lads_policy_instruction(policy, number, to)).expect("it is known");
            let texts = [got.id, got.text, got.sub_tasks].map(|t| t.as_str());
            assert_eq!(texts, [known.id, known.text, known.sub_tasks]);
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

    let mut parts = with_golden(parts(&Model::random(Spec::TINY, 11)), 12);
    let episode = parts.golden.as_mut().expect("there is one");
    episode.actions[3] += 0.5;
    let mut host = Host::new(parts.image());
    let c = host.controller();
    // SAFETY: the controller is alive.
    let status = unsafe { lads_self_test(c, null_mut()) };
    assert_eq!(status, Status::SelfTestAction);
    instruct(c, 0);
    assert_eq!(step(c, &[0.0; 3], &mut action).0, Status::NotArmed);
    parts.golden = None;
    let mut host = Host::new(parts.image());
    // SAFETY: the controller is alive.
    let status = unsafe { lads_self_test(host.controller(), null_mut()) };
    assert_eq!(status, Status::NoGolden);
}

#[test]
fn images_that_are_none_are_refused() {
    let image = image();
    let refused = |bytes: &[u8]| open(bytes).err();
    assert_eq!(refused(image.bytes()), None);
    assert_eq!(refused(&[]), Some(Status::ImageTruncated));
    for len in 0..image.bytes().len() {
        assert_eq!(refused(&image.bytes()[..len]), Some(Status::ImageTruncated));
    }
    assert_eq!(refused(&image.bytes()[1..]), Some(Status::NotAnImage));
    let edited = |word: usize, value: u32| {
        let mut changed = image.clone();
        changed.0[word] ^= value;
        refused(changed.bytes())
    };
    assert_eq!(edited(0, 1), Some(Status::NotAnImage));
    assert_eq!(edited(1, 1 << 20), Some(Status::ImageVersion));
    assert_eq!(edited(9, u32::MAX), Some(Status::ImageMalformed));
    assert_eq!(edited(image.0.len() - 1, 1), Some(Status::ImageChecksum));
    let mut policy = open(image.bytes()).expect("the image is sound");
    let bytes = image.bytes();
    // SAFETY: null is refused, and so is a length that no memory has.
    unsafe {
        assert_eq!(
            lads_policy_open(null(), 100, &raw mut *policy),
            Status::Null
        );
        assert_eq!(
            lads_policy_open(bytes.as_ptr(), bytes.len(), null_mut()),
            Status::Null
        );
        let odd = (&raw mut *policy).wrapping_byte_add(4);
        assert_eq!(
            lads_policy_open(bytes.as_ptr(), bytes.len(), odd),
            Status::Misaligned
        );
        assert_eq!(
            lads_policy_open(bytes.as_ptr(), usize::MAX, &raw mut *policy),
            Status::TooLong
        );
        // A failed attempt leaves no policy behind.
        let policy = &raw const *policy;
        assert_eq!(lads_workspace_bytes(policy), 0);
        assert_eq!(lads_workspace_bytes(null()), 0);
        let contract = written(|to| lads_policy_contract(policy, to)).err();
        assert_eq!(contract, Some(Status::NotSetUp));
    }
}

#[test]
fn policies_and_controllers_that_were_moved_or_never_set_up_are_refused() {
    let mut host = Host::new(image());
    // SAFETY: the policy is alive, and so is its copy.
    unsafe {
        let copy = Box::new((&raw const *host.policy).read());
        assert_eq!(lads_workspace_bytes(&raw const *copy), 0);
    }
    let made = host.memory().cast();
    assert_eq!(step(made, &[0.0; 3], &mut [0.0; 2]).0, Status::NotSetUp);
    host.workspace.fill(Line([0; LINE]));
    assert_eq!(step(made, &[0.0; 3], &mut [0.0; 2]).0, Status::NotSetUp);
    host.controller();
    let mut moved = host.workspace.clone();
    let moved = moved.as_mut_ptr().cast();
    assert_eq!(step(moved, &[0.0; 3], &mut [0.0; 2]).0, Status::NotSetUp);
    let odd = made.wrapping_byte_add(8);
    assert_eq!(step(odd, &[0.0; 3], &mut [0.0; 2]).0, Status::Misaligned);
    // SAFETY: null is refused.
    unsafe {
        let mut counters = LadsCounters::default();
        for status in [
            lads_reset(null_mut()),
            lads_warm(null_mut()),
            lads_stop(null_mut()),
            lads_resume(null_mut()),
            lads_set_instruction(null_mut(), 0),
            lads_set_words(null_mut(), null(), 0),
            lads_set_decision(null_mut(), 0.0, 0),
            lads_executed(null_mut(), null(), 0),
            lads_self_test(null_mut(), null_mut()),
            lads_counters(null_mut(), &raw mut counters),
            step(null_mut(), &[0.0; 3], &mut [0.0; 2]).0,
        ] {
            assert_eq!(status, Status::Null);
        }
    }
}

#[test]
fn workspaces_that_do_not_fit_are_refused() {
    let mut host = Host::new(image());
    let (memory, bytes, options) = (host.memory(), host.bytes(), LadsOptions::default());
    let policy = &raw const *host.policy;
    let image = host.image.bytes().as_ptr().cast_mut().cast();
    let init = |policy, memory: *mut c_void, bytes| {
        // SAFETY: each of these is refused before the memory is used, but for the last one.
        unsafe { lads_controller_init(policy, memory, bytes, &raw const options, null_mut()) }
    };
    assert_eq!(init(null(), memory, bytes), Status::Null);
    assert_eq!(init(policy, null_mut(), bytes), Status::Null);
    assert_eq!(init(policy, memory, bytes - 1), Status::WorkspaceTooSmall);
    assert_eq!(init(policy, memory, 0), Status::WorkspaceTooSmall);
    assert_eq!(init(policy, memory, usize::MAX), Status::TooLong);
    for offset in [1, 4, 8, 32] {
        let odd = memory.wrapping_byte_add(offset);
        assert_eq!(init(policy, odd, bytes), Status::Misaligned);
    }
    // The image lies inside what would be the workspace.
    let around: *mut c_void = image;
    let around = around.map_addr(|address| address & !(LINE - 1));
    assert_eq!(init(policy, around, bytes), Status::Overlap);
    let around = policy.cast_mut().cast::<c_void>();
    let around = around.map_addr(|address| address & !(LINE - 1));
    assert_eq!(init(policy, around, bytes), Status::Overlap);
    assert_eq!(init(policy, memory, bytes), Status::Ok);
}

#[test]
fn options_are_checked() {
    let mut host = Host::new(image());
    let mut refused = |options: LadsOptions| host.init(&options).0;
    let none = LadsOptions::default();
    assert_eq!(
        refused(LadsOptions { flags: 4, ..none }),
        Status::UnknownOption
    );
    assert_eq!(
        refused(LadsOptions {
            fallback: 3,
            ..none
        }),
        Status::UnknownOption
    );
    let decay = LadsOptions {
        fallback: LADS_FALLBACK_DECAY,
        ..none
    };
    assert_eq!(refused(decay), Status::GuardTimeConstant);
    assert_eq!(
        refused(LadsOptions {
            decay_s: 0.5,
            ..decay
        }),
        Status::Ok
    );
    let (nan, large) = ([0.0, f32::NAN], [99.0_f32; 2]);
    let [nan, large] = [nan.as_ptr(), large.as_ptr()];
    assert_eq!(
        refused(LadsOptions { min: nan, ..none }),
        Status::GuardLimits
    );
    assert_eq!(
        refused(LadsOptions { min: large, ..none }),
        Status::GuardLimits
    );
    assert_eq!(refused(LadsOptions { max: large, ..none }), Status::Ok);
    assert_eq!(
        refused(LadsOptions {
            max_rate: nan,
            ..none
        }),
        Status::GuardRate
    );
    assert_eq!(
        refused(LadsOptions {
            safe_action: large,
            ..none
        }),
        Status::GuardSafeAction
    );
    let odd = nan.wrapping_byte_add(2);
    assert_eq!(
        refused(LadsOptions { min: odd, ..none }),
        Status::Misaligned
    );
    // After a refusal there is no controller.
    let memory = host.memory().cast();
    assert_eq!(host.init(&none).0, Status::Ok);
    assert_eq!(
        host.init(&LadsOptions {
            max_rate: nan,
            ..none
        })
        .0,
        Status::GuardRate
    );
    let status = step(memory, &[0.0; 3], &mut [0.0; 2]).0;
    assert!(matches!(status, Status::NotSetUp | Status::NotArmed));
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
    };
    wrong(&[0.0; 2], Status::ObservationLength);
    wrong(&[], Status::ObservationLength);
    wrong(&[0.0, f32::NAN, 0.0], Status::NotFinite);
    wrong(&[0.0, 0.0, 4.0], Status::OutOfLimits);
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
            missed: 0,
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
fn a_wrong_call_does_nothing() {
    let mut host = Host::new(image());
    let c = host.controller();
    let mut action = [7.0_f32; 2];
    let observation = [0.0_f32; 3];
    let from = observation.as_ptr();
    // SAFETY: the controller is alive; each call is refused before what is wrong is used.
    unsafe {
        assert_eq!(lads_set_instruction(c, 2), Status::UnknownInstruction);
        assert_eq!(lads_set_words(c, from, 3), Status::WordsLength);
        assert_eq!(lads_set_words(c, null(), 0), Status::WordsLength);
        assert_eq!(lads_set_words(c, null(), 4), Status::Null);
        assert_eq!(lads_set_words(c, c.cast(), 4), Status::Overlap);
        assert_eq!(
            lads_set_words(c, [f32::NAN; 4].as_ptr(), 4),
            Status::WordsNotFinite
        );
        instruct(c, 0);
        assert_eq!(lads_executed(c, from, 2), Status::NothingExecuted);
        assert_eq!(lads_executed(c, c.cast(), 2), Status::Overlap);
        let odd = LadsReport::default();
        let odd = (&raw const odd).cast_mut().wrapping_byte_add(1);
        let to = action.as_mut_ptr();
        assert_eq!(
            lads_step(c, from, 3, null(), to, 2, odd),
            Status::Misaligned
        );
        assert_eq!(
            lads_step(c, from, 3, odd.cast(), to, 2, null_mut()),
            Status::Misaligned
        );
        assert_eq!(
            lads_step(c, from, 3, null(), null_mut(), 2, null_mut()),
            Status::Null
        );
        assert_eq!(
            lads_step(c, from, 3, null(), c.cast(), 2, null_mut()),
            Status::Overlap
        );
        assert_eq!(
            lads_self_test(c, to.wrapping_byte_add(1).cast()),
            Status::Misaligned
        );
        assert_eq!(lads_counters(c, null_mut()), Status::Null);
    }
    assert_eq!(
        step(c, &observation, &mut action[..1]).0,
        Status::ActionLength
    );
    assert_eq!(step(c, &observation, &mut []).0, Status::ActionLength);
    assert_eq!((action, counters(c).periods), ([7.0; 2], 0));
    assert_eq!(step(c, &observation, &mut action).0, Status::Ok);
    assert_ne!(action, [7.0; 2]);
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
            bits.push((action.map(f32::to_bits), report.plan));
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
        let init = |to| {
            // SAFETY: as above; the workspace is this thread's own.
            unsafe { lads_controller_init(policy, memory, bytes, &raw const options, to) }
        };
        let c = written(init).expect("the workspace suffices");
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
    let plans = |temperature: f32, seed: u64| {
        let mut host = Host::new(image());
        let c = host.controller();
        // SAFETY: the controller is alive.
        let status = unsafe { lads_set_decision(c, temperature, seed) };
        assert_eq!(status, Status::Ok);
        instruct(c, 0);
        let plan = |_| {
            let (status, report) = step(c, &[0.1; 3], &mut [0.0; 2]);
            assert_eq!(status, Status::Ok);
            report.plan
        };
        (0..60).map(plan).collect::<Vec<_>>()
    };
    assert_eq!(plans(3.0, 1), plans(3.0, 1));
    assert_ne!(plans(3.0, 1), plans(3.0, 2));
    assert_eq!(plans(0.0, 1), plans(0.0, 2));
    assert_eq!(plans(f32::NAN, 1), plans(0.0, 2));
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
