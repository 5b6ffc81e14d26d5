//! Tests of structs that begin with their size: older and newer callers, and invalid sizes.

use core::ptr::{null, null_mut};

use crate::host::*;
use lads_ffi::*;

/// A struct as a newer header might have it: with fields that this library does not know.
#[repr(C)]
#[derive(Clone, Copy)]
struct Newer<T> {
    known: T,
    later: [u64; 2],
}

const PAINT: u64 = 0x5a5a_5a5a_5a5a_5a5a;

/// Sets the size at the head.
fn sized<T>(value: &mut T, bytes: usize) {
    // SAFETY: every struct that is passed begins with a `u32`.
    unsafe { (&raw mut *value).cast::<u32>().write(bytes as u32) };
}

#[test]
fn sizes_that_are_none_are_refused() {
    let mut host = Host::new(image());
    let c = host.controller();
    let policy = &raw const *host.policy;
    for bytes in [0, 4, size_of::<LadsReport>() - 4, 4097, usize::MAX] {
        let mut report = LadsReport::default();
        sized(&mut report, bytes);
        let mut test = LadsSelfTest::default();
        sized(&mut test, bytes.min(16));
        let mut count = LadsCounters::default();
        sized(&mut count, bytes.min(16));
        let mut contract = LadsContract::default();
        sized(&mut contract, bytes.min(16));
        // SAFETY: all of it is alive.
        unsafe {
            let status = lads_executed(c, null(), 0, &raw mut report);
            assert_eq!(status, Status::StructBytes, "{bytes}");
            assert_eq!(lads_self_test(c, &raw mut test), Status::StructBytes);
            assert_eq!(lads_counters(c, &raw mut count), Status::StructBytes);
            assert_eq!(
                lads_policy_contract(policy, &raw mut contract),
                Status::StructBytes
            );
        }
        let mut options = LadsOptions::default();
        sized(&mut options, bytes.min(16));
        assert_eq!(host.init(&options).0, Status::StructBytes);
    }
}

#[test]
fn what_a_newer_caller_has_beyond_stays_untouched() {
    let mut host = Host::new(image());
    let c = host.controller();
    instruct(c, 0);
    let later = [PAINT; 2];
    let mut report = Newer {
        known: LadsReport::default(),
        later,
    };
    sized(&mut report, size_of::<Newer<LadsReport>>());
    let mut contract = Newer {
        known: LadsContract::default(),
        later,
    };
    sized(&mut contract, size_of::<Newer<LadsContract>>());
    let (mut action, observation) = ([0.0_f32; 2], [0.1_f32; 3]);
    // SAFETY: all of it is alive.
    unsafe {
        let (o, a) = (observation.as_ptr(), action.as_mut_ptr());
        let status = lads_step(c, o, 3, null(), a, 2, (&raw mut report).cast());
        assert_eq!(status, Status::Ok);
        let status = lads_policy_contract(&raw const *host.policy, (&raw mut contract).cast());
        assert_eq!(status, Status::Ok);
    }
    assert_eq!((report.known.stepped, report.later), (1, later));
    assert_eq!((contract.known.action_len, contract.later), (2, later));
    // The size is the caller's.
    assert_eq!(
        report.known.struct_bytes as usize,
        size_of::<Newer<LadsReport>>()
    );
}

#[test]
fn options_that_are_not_known_are_refused_unless_they_are_zero() {
    let mut host = Host::new(image());
    let (memory, bytes, policy) = (host.memory(), host.bytes(), &raw const *host.policy);
    let init = |later: [u64; 2]| {
        let mut options = Newer {
            known: LadsOptions::default(),
            later,
        };
        sized(&mut options, size_of::<Newer<LadsOptions>>());
        let options = (&raw const options).cast();
        // SAFETY: all of it is alive.
        unsafe { lads_controller_init(policy, memory, bytes, options, null_mut(), null_mut()) }
    };
    assert_eq!(init([0, 0]), Status::Ok);
    assert_eq!(init([0, 1]), Status::UnknownOption);
    let c = host.controller();
    instruct(c, 0);
    let mut tick = Newer {
        known: LadsTick {
            timestamp: 3,
            ..LadsTick::default()
        },
        later: [0, 9],
    };
    sized(&mut tick, size_of::<Newer<LadsTick>>());
    let (mut action, observation) = ([7.0_f32; 2], [0.1_f32; 3]);
    let (o, a) = (observation.as_ptr(), action.as_mut_ptr());
    // SAFETY: all of it is alive.
    let status = unsafe { lads_step(c, o, 3, (&raw const tick).cast(), a, 2, null_mut()) };
    assert_eq!((status, action), (Status::UnknownOption, [0.0; 2]));
}
