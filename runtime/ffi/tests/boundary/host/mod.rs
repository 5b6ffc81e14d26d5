//! Memory and helpers of a C program around the library, for tests that call it as C does.

#[path = "../../../../core/tests/support/mod.rs"]
pub mod support;

use core::ffi::c_void;
use core::ptr::{null, null_mut};

use lads_ffi::*;
use support::assemble::parts;
use support::writer::Parts;
use support::{Image, Model, Spec};

/// Makes a small LADS policy with a recorded episode.
pub fn lads(seed: u64) -> Parts {
    parts(&Model::random(Spec::TINY, seed)).with_golden(12)
}

pub fn image() -> Image {
    lads(11).image()
}

pub const LINE: usize = LADS_WORKSPACE_ALIGN;

/// A cache line.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub struct Line(pub [u8; LINE]);

/// Memory that a C program would allocate for one controller.
pub struct Host {
    pub image: Image,
    pub policy: Box<LadsPolicy>,
    pub workspace: Vec<Line>,
}

/// Opens a policy, or returns the reason why not.
pub fn open(bytes: &[u8]) -> Result<Box<LadsPolicy>, Status> {
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
    pub fn new(image: Image) -> Self {
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

    pub fn bytes(&self) -> usize {
        self.workspace.len() * LINE
    }

    pub fn memory(&mut self) -> *mut c_void {
        self.workspace.as_mut_ptr().cast()
    }

    pub fn init(&mut self, options: &LadsOptions) -> (Status, *mut LadsController) {
        let (memory, bytes, mut made) = (self.memory(), self.bytes(), null_mut());
        // SAFETY: all of it is alive; the tests' lists are as long as an action.
        let status = unsafe {
            lads_controller_init(
                &raw const *self.policy,
                memory,
                bytes,
                options,
                &raw mut made,
                null_mut(),
            )
        };
        (status, made)
    }

    /// Sets up a controller that is not tested.
    pub fn controller(&mut self) -> *mut LadsController {
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

pub fn step(
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

pub fn instruct(controller: *mut LadsController, number: u32) {
    // SAFETY: the controller is alive.
    let status = unsafe { lads_set_instruction(controller, number) };
    assert_eq!(status, Status::Ok);
}

pub fn counters(controller: *mut LadsController) -> LadsCounters {
    // SAFETY: the controller is alive.
    written(|to| unsafe { lads_counters(controller, to) }).expect("it is alive")
}

/// Returns the value that a function, which returns a status, writes through a pointer.
pub fn written<T: Default>(f: impl FnOnce(*mut T) -> Status) -> Result<T, Status> {
    let mut value = T::default();
    match f(&raw mut value) {
        Status::Ok => Ok(value),
        status => Err(status),
    }
}

/// Returns the values of a channel in C's form.
pub fn input(channel: u32, values: &support::Values) -> LadsInput {
    let (dtype, data, len) = match values {
        support::Values::F32(values) => (LADS_F32, values.as_ptr().cast(), values.len()),
        support::Values::U8(values) => (LADS_U8, values.as_ptr().cast(), values.len()),
        support::Values::I32(values) => (LADS_I32, values.as_ptr().cast(), values.len()),
    };
    LadsInput {
        channel,
        dtype,
        data,
        len,
        row_bytes: 0,
    }
}

/// Runs one control period with any channels.
pub fn step_channels(
    controller: *mut LadsController,
    inputs: &[LadsInput],
    action: &mut [f32],
) -> (Status, LadsReport) {
    let mut report = LadsReport::default();
    // SAFETY: the inputs and their values are alive, and so are the action and the controller.
    let status = unsafe {
        lads_step_channels(
            controller,
            inputs.as_ptr(),
            inputs.len(),
            null(),
            action.as_mut_ptr(),
            action.len(),
            &raw mut report,
        )
    };
    (status, report)
}
