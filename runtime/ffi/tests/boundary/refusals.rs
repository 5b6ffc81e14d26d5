//! Tests that every wrong pointer, length, image or order of calls is refused with its number.

use core::ffi::c_void;
use core::ptr::{null, null_mut};

use crate::host::support::assemble::ACTION;
use crate::host::*;
use lads_ffi::*;

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
            lads_set_words(null_mut(), null(), 0, null_mut()),
            lads_set_decision(null_mut(), 0.0, 0),
            lads_executed(null_mut(), null(), 0, null_mut()),
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
        unsafe {
            lads_controller_init(
                policy,
                memory,
                bytes,
                &raw const options,
                null_mut(),
                null_mut(),
            )
        }
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
}

/// Sets up a controller wrongly in memory in which one runs, in every way, and asserts what is said.
fn refused_set_ups(host: &mut Host) {
    let (memory, bytes, policy) = (host.memory(), host.bytes(), &raw const *host.policy);
    let refused = |options: LadsOptions| {
        let mut report = LadsReport::default();
        let (options, report) = (&raw const options, &raw mut report);
        // SAFETY: all of it is alive; the lists are as long as an action.
        unsafe {
            let status = lads_controller_init(policy, memory, bytes, options, null_mut(), report);
            (status, (*report).channel, (*report).element)
        }
    };
    let none = LadsOptions::default();
    let nan = [1.0, f32::NAN];
    let low = [99.0, 99.0];
    let (nan, low) = (nan.as_ptr(), low.as_ptr());
    let rate = LadsOptions {
        max_rate: nan,
        ..none
    };
    assert_eq!(refused(rate), (Status::GuardRate, ACTION, 1));
    let limits = LadsOptions { min: low, ..none };
    assert_eq!(refused(limits), (Status::GuardLimits, ACTION, 0));
    let safe = LadsOptions {
        safe_action: low,
        ..none
    };
    assert_eq!(refused(safe), (Status::GuardSafeAction, ACTION, 0));
    let decay = LadsOptions {
        fallback: LADS_FALLBACK_DECAY,
        ..none
    };
    assert_eq!(
        refused(decay),
        (Status::GuardTimeConstant, LADS_NONE, LADS_NONE)
    );
    let flags = LadsOptions { flags: 64, ..none };
    assert_eq!(
        refused(flags),
        (Status::UnknownOption, LADS_NONE, LADS_NONE)
    );
    // SAFETY: each of these is refused before anything is written.
    unsafe {
        let init = |policy, bytes| {
            lads_controller_init(policy, memory, bytes, null(), null_mut(), null_mut())
        };
        assert_eq!(init(policy, bytes - 1), Status::WorkspaceTooSmall);
        assert_eq!(init(null(), bytes), Status::Null);
    }
}

#[test]
fn a_refused_set_up_names_the_element_and_the_controller_goes_on() {
    let (mut host, mut other) = (Host::new(image()), Host::new(image()));
    let both = [host.controller(), other.controller()];
    for c in both {
        instruct(c, 0);
    }
    for i in 0..12 {
        let actions = both.map(|c| {
            let mut action = [7.0; 2];
            assert_eq!(step(c, &[0.1; 3], &mut action).0, Status::Ok);
            action.map(f32::to_bits)
        });
        assert_eq!(actions[0], actions[1], "step {i}");
        refused_set_ups(&mut host);
    }
}

#[test]
fn a_refused_set_up_touches_no_byte() {
    let mut host = Host::new(image());
    let c = host.controller();
    instruct(c, 0);
    assert_eq!(step(c, &[0.1; 3], &mut [7.0; 2]).0, Status::Ok);
    let bytes = |host: &Host| host.workspace.iter().map(|line| line.0).collect::<Vec<_>>();
    let before = bytes(&host);
    refused_set_ups(&mut host);
    assert!(
        before == bytes(&host),
        "a refusal has touched the workspace"
    );
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
        assert_eq!(lads_set_words(c, from, 3, null_mut()), Status::WordsLength);
        assert_eq!(
            lads_set_words(c, null(), 0, null_mut()),
            Status::WordsLength
        );
        assert_eq!(lads_set_words(c, null(), 4, null_mut()), Status::Null);
        assert_eq!(lads_set_words(c, c.cast(), 4, null_mut()), Status::Overlap);
        let mut report = LadsReport::default();
        assert_eq!(
            lads_set_words(c, [0.0, 0.0, f32::NAN, 0.0].as_ptr(), 4, &raw mut report),
            Status::WordsNotFinite
        );
        assert_eq!((report.channel, report.element), (LADS_NONE, 2));
        instruct(c, 0);
        assert_eq!(
            lads_executed(c, from, 2, null_mut()),
            Status::NothingExecuted
        );
        assert_eq!(lads_executed(c, c.cast(), 2, null_mut()), Status::Overlap);
        let to = action.as_mut_ptr();
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
