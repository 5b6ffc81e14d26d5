//! What a C program would have around the library, for tests that call it as C does.
#![allow(dead_code, reason = "each suite uses its part")]

#[path = "../../../core/tests/support/mod.rs"]
pub mod support;

use core::ffi::c_void;
use core::mem::MaybeUninit;
use core::ptr::{null, null_mut};

use lads_ffi::*;
use support::assemble::{parts, with_golden};
use support::{Image, Model, Spec};

pub fn image() -> Image {
    with_golden(parts(&Model::random(Spec::TINY, 11)), 12).image()
}

pub const LINE: usize = LADS_WORKSPACE_ALIGN;

/// A cache line.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub struct Line(pub [u8; LINE]);

/// Everything that a C program would allocate for one controller.
pub struct Host {
    pub image: Image,
    pub policy: Box<LadsPolicy>,
    pub workspace: Vec<Line>,
}

/// An opened policy, or why not.
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
            )
        };
        (status, made)
    }

    /// A controller that nobody has tested.
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
    let mut counters = LadsCounters::default();
    // SAFETY: the controller is alive.
    let status = unsafe { lads_counters(controller, &raw mut counters) };
    assert_eq!(status, Status::Ok);
    counters
}

/// What is written through a pointer by a function that returns a status.
pub fn written<T>(f: impl FnOnce(*mut T) -> Status) -> Result<T, Status> {
    let mut value = MaybeUninit::uninit();
    match f(value.as_mut_ptr()) {
        // SAFETY: the functions write what they return `Ok` for.
        Status::Ok => Ok(unsafe { value.assume_init() }),
        status => Err(status),
    }
}
