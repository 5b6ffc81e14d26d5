//! The C functions, called from Rust as C would call them: the same results as the controller, and every wrong pointer, length
//! or image refused with its number.

#[path = "../../core/tests/support/mod.rs"]
mod support;

use core::ffi::{CStr, c_void};
use core::ptr::{null, null_mut};

use lads_core::Instruction;
use lads_ffi::{
    Areas, LADS_CONTROLLER_ALIGN, PolicyInfo, Report, Status, lads_controller_bytes,
    lads_controller_init, lads_executed, lads_policy_open, lads_reset, lads_self_test,
    lads_set_decision, lads_set_instruction, lads_set_words, lads_status_text, lads_step,
};
use support::assemble::{parts, with_golden};
use support::{Image, Memory, Model, Random, Spec};

fn image() -> Image {
    with_golden(parts(&Model::random(Spec::TINY, 11)), 12).image()
}

/// Everything that a C program would allocate for one controller.
struct Host {
    image: Image,
    memory: Vec<u128>,
    arena: Vec<f32>,
    state: Vec<f32>,
}

impl Host {
    fn new(image: Image) -> Self {
        let mut info = PolicyInfo::default();
        // SAFETY: the image and the info are alive.
        let status =
            unsafe { lads_policy_open(image.bytes().as_ptr(), image.bytes().len(), &raw mut info) };
        assert_eq!(status, Status::Ok);
        let memory = vec![u128::MAX; lads_controller_bytes().div_ceil(16)];
        Self {
            image,
            memory,
            arena: vec![f32::NAN; info.arena_len],
            state: vec![f32::NAN; info.state_len],
        }
    }

    fn areas(&mut self) -> Areas {
        Areas {
            image: self.image.bytes().as_ptr(),
            image_bytes: self.image.bytes().len(),
            arena: self.arena.as_mut_ptr(),
            arena_len: self.arena.len(),
            state: self.state.as_mut_ptr(),
            state_len: self.state.len(),
        }
    }

    fn init(&mut self, areas: &Areas) -> Status {
        let bytes = self.memory.len() * 16;
        // SAFETY: each test passes areas that this host owns, or ones that are refused before they are used.
        unsafe { lads_controller_init(self.memory.as_mut_ptr().cast(), bytes, areas) }
    }

    /// A controller in this host's memory.
    fn controller(&mut self) -> *mut c_void {
        let areas = self.areas();
        assert_eq!(self.init(&areas), Status::Ok);
        self.memory.as_mut_ptr().cast()
    }
}

fn step(
    controller: *mut c_void,
    observation: &[f32],
    action: &mut [f32],
    report: *mut Report,
) -> Status {
    let (o, a) = (observation.len(), action.len());
    // SAFETY: the slices are alive, and each test passes a controller of a host that is alive, or null.
    unsafe {
        lads_step(
            controller,
            observation.as_ptr(),
            o,
            action.as_mut_ptr(),
            a,
            report,
        )
    }
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
            // SAFETY: the controller is alive.
            let status = unsafe { lads_set_instruction(c, 1) };
            assert_eq!(status, Status::Ok);
        }
        if t == 20 {
            expected.reset();
            // SAFETY: the controller is alive.
            let status = unsafe { lads_reset(c) };
            assert_eq!(status, Status::Ok);
        }
        let observation = random.vec(3, 1.0);
        let (mut action, mut other, mut report) = ([0.0; 2], [0.0; 2], Report::default());
        let made = expected
            .step(&observation, &mut other)
            .expect("the step is sound");
        assert_eq!(
            step(c, &observation, &mut action, &raw mut report),
            Status::Ok
        );
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
    // A null report is one that nobody wants.
    assert_eq!(step(c, &[0.0; 3], &mut [0.0; 2], null_mut()), Status::Ok);
}

#[test]
fn the_sizes_are_the_policys() {
    let image = image();
    let policy = image.policy();
    let mut info = PolicyInfo::default();
    // SAFETY: the image and the info are alive.
    let status =
        unsafe { lads_policy_open(image.bytes().as_ptr(), image.bytes().len(), &raw mut info) };
    assert_eq!(status, Status::Ok);
    assert_eq!(
        (info.arena_len, info.state_len),
        (policy.arena_len(), policy.state_len())
    );
    assert_eq!(
        (
            info.observation_len,
            info.action_len,
            info.horizon,
            info.codebook_len
        ),
        (3, 2, 3, 5)
    );
    assert_eq!(
        (
            info.words_len,
            info.word_dim,
            info.instruction_count,
            info.context_steps
        ),
        (4, 4, 2, 8)
    );
    assert_eq!(info.control_period_s, 0.08);
}

#[test]
fn the_self_test_passes_and_fails() {
    let mut host = Host::new(image());
    let c = host.controller();
    let mut error = f32::NAN;
    // SAFETY: the controller and the error are alive.
    unsafe {
        assert_eq!(lads_self_test(c, &raw mut error), Status::Ok);
        assert_eq!(lads_self_test(c, null_mut()), Status::Ok);
    }
    assert_eq!(error, 0.0);
    assert_eq!(
        step(c, &[0.0; 3], &mut [0.0; 2], null_mut()),
        Status::NoInstruction
    );

    let mut parts = with_golden(parts(&Model::random(Spec::TINY, 11)), 12);
    let episode = parts.golden.as_mut().expect("there is one");
    episode.actions[3] += 0.5;
    let mut host = Host::new(parts.image());
    // SAFETY: the controller is alive.
    let status = unsafe { lads_self_test(host.controller(), null_mut()) };
    assert_eq!(status, Status::SelfTestAction);
    parts.golden = None;
    let mut host = Host::new(parts.image());
    // SAFETY: the controller is alive.
    let status = unsafe { lads_self_test(host.controller(), null_mut()) };
    assert_eq!(status, Status::NoGolden);
}

#[test]
fn images_that_are_none_are_refused() {
    let image = image();
    let mut info = PolicyInfo::default();
    let mut open = |bytes: &[u8]| {
        // SAFETY: the bytes and the info are alive.
        unsafe { lads_policy_open(bytes.as_ptr(), bytes.len(), &raw mut info) }
    };
    assert_eq!(open(&[]), Status::ImageTruncated);
    assert_eq!(
        open(&image.bytes()[..image.bytes().len() - 1]),
        Status::ImageTruncated
    );
    assert_eq!(open(&image.bytes()[1..]), Status::NotAnImage);
    let mut edited = |word: usize, value: u32| {
        let mut changed = image.clone();
        changed.0[word] ^= value;
        open(changed.bytes())
    };
    assert_eq!(edited(0, 1), Status::NotAnImage);
    assert_eq!(edited(1, 2), Status::ImageVersion);
    assert_eq!(edited(9, u32::MAX), Status::ImageMalformed);
    assert_eq!(edited(image.0.len() - 1, 1), Status::ImageChecksum);
    // SAFETY: null is refused.
    unsafe {
        assert_eq!(lads_policy_open(null(), 100, &raw mut info), Status::Null);
        let bytes = image.bytes();
        assert_eq!(
            lads_policy_open(bytes.as_ptr(), bytes.len(), null_mut()),
            Status::Null
        );
        assert_eq!(
            lads_policy_open(bytes.as_ptr(), usize::MAX, &raw mut info),
            Status::TooLong
        );
    }
}

#[test]
fn memory_that_does_not_fit_is_refused() {
    let mut host = Host::new(image());
    let areas = host.areas();
    assert_eq!(
        host.init(&Areas {
            image: null(),
            ..areas
        }),
        Status::Null
    );
    assert_eq!(
        host.init(&Areas {
            arena: null_mut(),
            ..areas
        }),
        Status::Null
    );
    assert_eq!(
        host.init(&Areas {
            arena_len: areas.arena_len - 1,
            ..areas
        }),
        Status::WorkspaceTooSmall
    );
    assert_eq!(
        host.init(&Areas {
            state_len: areas.state_len - 1,
            ..areas
        }),
        Status::WorkspaceTooSmall
    );
    assert_eq!(
        host.init(&Areas {
            state: areas.arena,
            ..areas
        }),
        Status::Overlap
    );
    let odd = areas.arena.cast::<u8>().wrapping_add(1).cast();
    let arena_len = areas.arena_len;
    let longer = Areas {
        arena: odd,
        arena_len,
        ..areas
    };
    assert_eq!(host.init(&longer), Status::Misaligned);
    let memory: *mut c_void = host.memory.as_mut_ptr().cast();
    let bytes = lads_controller_bytes();
    // SAFETY: each of these is refused before the memory is used.
    unsafe {
        assert_eq!(
            lads_controller_init(null_mut(), bytes, &raw const areas),
            Status::Null
        );
        assert_eq!(lads_controller_init(memory, bytes, null()), Status::Null);
        assert_eq!(
            lads_controller_init(memory, bytes - 1, &raw const areas),
            Status::ControllerTooSmall
        );
        let shifted = memory
            .cast::<u8>()
            .wrapping_add(LADS_CONTROLLER_ALIGN / 2)
            .cast();
        assert_eq!(
            lads_controller_init(shifted, bytes, &raw const areas),
            Status::Misaligned
        );
    }
    assert_eq!(host.init(&areas), Status::Ok);
}

#[test]
fn calls_that_are_refused_name_the_reason_and_leave_the_action() {
    let mut host = Host::new(image());
    let c = host.controller();
    let mut action = [7.0; 2];
    assert_eq!(
        step(c, &[0.0; 3], &mut action, null_mut()),
        Status::NoInstruction
    );
    // SAFETY: the controller is alive, or null and refused.
    unsafe {
        assert_eq!(lads_set_instruction(c, 2), Status::UnknownInstruction);
        assert_eq!(
            lads_set_words(c, [0.0_f32; 3].as_ptr(), 3),
            Status::WordsLength
        );
        assert_eq!(lads_set_words(c, null(), 0), Status::WordsLength);
        assert_eq!(lads_set_words(c, null(), 4), Status::Null);
        assert_eq!(
            lads_set_words(c, [f32::NAN; 4].as_ptr(), 4),
            Status::WordsNotFinite
        );
        assert_eq!(lads_set_instruction(c, 0), Status::Ok);
        assert_eq!(
            lads_executed(c, [0.0_f32; 2].as_ptr(), 2),
            Status::NothingExecuted
        );
        for null in [
            lads_reset(null_mut()),
            lads_set_instruction(null_mut(), 0),
            lads_self_test(null_mut(), null_mut()),
        ] {
            assert_eq!(null, Status::Null);
        }
        let twice = [0.0_f32; 3];
        let aliased = twice.as_ptr().cast_mut();
        assert_eq!(
            lads_step(c, twice.as_ptr(), 3, aliased, 2, null_mut()),
            Status::Overlap
        );
        assert_eq!(
            lads_step(c, null(), 3, action.as_mut_ptr(), 2, null_mut()),
            Status::Null
        );
    }
    assert_eq!(
        step(null_mut(), &[0.0; 3], &mut action, null_mut()),
        Status::Null
    );
    assert_eq!(
        step(c, &[0.0; 2], &mut action, null_mut()),
        Status::ObservationLength
    );
    assert_eq!(
        step(c, &[0.0, f32::NAN, 0.0], &mut action, null_mut()),
        Status::NotFinite
    );
    assert_eq!(
        step(c, &[0.0, 0.0, 4.0], &mut action, null_mut()),
        Status::OutOfLimits
    );
    assert_eq!(
        step(c, &[0.0; 3], &mut action[..1], null_mut()),
        Status::ActionLength
    );
    assert_eq!(action, [7.0; 2]);
    assert_eq!(step(c, &[0.0; 3], &mut action, null_mut()), Status::Ok);
    assert_ne!(action, [7.0; 2]);
}

#[test]
fn sampling_follows_the_seed() {
    let plans = |temperature: f32, seed: u64| {
        let mut host = Host::new(image());
        let c = host.controller();
        // SAFETY: the controller is alive.
        unsafe {
            assert_eq!(lads_set_decision(c, temperature, seed), Status::Ok);
            assert_eq!(lads_set_instruction(c, 0), Status::Ok);
        }
        let plan = |_| {
            let mut report = Report::default();
            assert_eq!(
                step(c, &[0.1; 3], &mut [0.0; 2], &raw mut report),
                Status::Ok
            );
            report.plan
        };
        (0..60).map(plan).collect::<Vec<_>>()
    };
    assert_eq!(plans(3.0, 1), plans(3.0, 1));
    assert_ne!(plans(3.0, 1), plans(3.0, 2));
    assert_eq!(plans(0.0, 1), plans(0.0, 2));
}

#[test]
fn every_status_has_a_text_of_its_own() {
    let text = |status| {
        // SAFETY: the text is a static string that ends in zero.
        let text = unsafe { CStr::from_ptr(lads_status_text(status)) };
        text.to_str().expect("the text is ASCII")
    };
    let mut texts: Vec<_> = Status::ALL
        .iter()
        .map(|&status| text(status as i32))
        .collect();
    assert!(
        texts
            .iter()
            .all(|text| !text.is_empty() && *text != "unknown status")
    );
    assert_eq!(
        (text(0), text(999), text(-1)),
        ("ok", "unknown status", "unknown status")
    );
    texts.sort_unstable();
    texts.dedup();
    assert_eq!(texts.len(), Status::ALL.len());
}
