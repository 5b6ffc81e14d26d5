//! Tests that memory areas of a call that overlap where one of them is written are refused,
//! whichever two they are. If there is room for an action, one is written, whatever else is wrong.

#![allow(
    clippy::cast_ptr_alignment,
    reason = "the places are aligned to eight bytes, which is what is tried"
)]

use core::ptr::{null, null_mut};

use crate::host::*;
use lads_ffi::*;

const OBSERVATION: [f32; 3] = [0.3, -0.2, 0.7];

/// Returns a controller that has taken a step, and its action.
fn started(host: &mut Host) -> (*mut LadsController, [f32; 2]) {
    let c = host.controller();
    instruct(c, 0);
    let mut action = [7.0; 2];
    assert_eq!(step(c, &OBSERVATION, &mut action).0, Status::Ok);
    (c, action)
}

/// Memory for two structs that may overlap.
#[repr(C, align(8))]
struct Shared([u8; 512]);

#[test]
fn a_report_over_the_action_leaves_the_action() {
    let mut host = Host::new(image());
    let (c, last) = started(&mut host);
    let mut shared = Shared([0; 512]);
    let report: *mut LadsReport = (&raw mut shared).cast();
    let action = report.wrapping_byte_add(4).cast::<f32>();
    // SAFETY: both lie in the shared memory.
    unsafe {
        report.write(LadsReport::default());
        let status = lads_step(c, OBSERVATION.as_ptr(), 3, null(), action, 2, report);
        assert_eq!(status, Status::Overlap);
        assert_eq!([action.read(), action.add(1).read()], last);
    }
    assert_eq!(counters(c).periods, 2);
}

#[test]
fn a_tick_over_the_action_or_the_report_counts_as_no_observation() {
    let mut host = Host::new(image());
    let (c, last) = started(&mut host);
    let mut shared = Shared([0; 512]);
    let tick: *mut LadsTick = (&raw mut shared).cast();
    // SAFETY: all lie in the shared memory.
    unsafe {
        tick.write(LadsTick {
            missed: 50,
            timestamp: 9,
            ..LadsTick::default()
        });
        let action = tick.wrapping_byte_add(8).cast::<f32>();
        let status = lads_step(c, OBSERVATION.as_ptr(), 3, tick, action, 2, null_mut());
        assert_eq!(status, Status::Overlap);
        assert_eq!([action.read(), action.add(1).read()], last);

        let mut apart = [f32::NAN; 2];
        let to = apart.as_mut_ptr();
        let report: *mut LadsReport = (&raw mut shared).cast();
        report.write(LadsReport::default());
        let status = lads_step(c, OBSERVATION.as_ptr(), 3, report.cast(), to, 2, report);
        assert_eq!((status, apart), (Status::Overlap, last));
        assert_eq!(report.read(), LadsReport::default());
    }
    // The clock was never read, so the next timestamp is not stale.
    let tick = LadsTick {
        timestamp: 1,
        ..LadsTick::default()
    };
    let mut action = [0.0; 2];
    // SAFETY: all of it is alive.
    let status = unsafe {
        lads_step(
            c,
            OBSERVATION.as_ptr(),
            3,
            &raw const tick,
            action.as_mut_ptr(),
            2,
            null_mut(),
        )
    };
    assert_eq!(status, Status::Ok);
}

#[test]
fn nothing_is_written_over_the_controller_or_the_image() {
    let mut host = Host::new(image());
    let (c, last) = started(&mut host);
    let inside = c.wrapping_byte_add(256);
    let image = host.image.bytes().as_ptr().cast_mut();
    let image = image.wrapping_add(image.align_offset(8)).wrapping_add(64);
    let mut action = [f32::NAN; 2];
    let to = action.as_mut_ptr();
    let o = OBSERVATION.as_ptr();
    // SAFETY: what is written lies in memory that is alive; the library refuses to write there.
    unsafe {
        for area in [inside.cast::<u8>(), image] {
            // What is there is to look like a struct with a size.
            let kept = area.cast::<u32>().read();
            let report = area.cast::<LadsReport>();
            let test = area.cast::<LadsSelfTest>();
            let count = area.cast::<LadsCounters>();
            area.cast::<u32>().write(size_of::<LadsReport>() as u32);
            assert_eq!(lads_step(c, o, 3, null(), to, 2, report), Status::Overlap);
            assert_eq!(action, last);
            assert_eq!(lads_executed(c, last.as_ptr(), 2, report), Status::Overlap);
            assert_eq!(lads_set_words(c, o, 3, report), Status::Overlap);
            assert_eq!(lads_swap(c, c, report), Status::Overlap);
            area.cast::<u32>().write(size_of::<LadsSelfTest>() as u32);
            assert_eq!(lads_self_test(c, test), Status::Overlap);
            area.cast::<u32>().write(size_of::<LadsCounters>() as u32);
            assert_eq!(lads_counters(c, count), Status::Overlap);
            let room = area.cast::<f32>();
            assert_eq!(
                lads_step(c, o, 3, null(), room, 2, null_mut()),
                Status::Overlap
            );
            area.cast::<u32>().write(kept);
        }
        // A tick in the workspace is not read; the action comes all the same.
        action = [f32::NAN; 2];
        let to = action.as_mut_ptr();
        inside.cast::<u32>().write(size_of::<LadsTick>() as u32);
        assert_eq!(
            lads_step(c, o, 3, inside.cast(), to, 2, null_mut()),
            Status::Overlap
        );
        assert_eq!(action, last);
    }
    assert_eq!(step(c, &OBSERVATION, &mut action).0, Status::Ok);
}

#[test]
fn options_and_lists_in_the_workspace_are_refused() {
    let mut host = Host::new(image());
    let (memory, bytes, policy) = (host.memory(), host.bytes(), &raw const *host.policy);
    let mut options = LadsOptions {
        flags: LADS_ARM_WITHOUT_SELF_TEST,
        ..LadsOptions::default()
    };
    let inside = memory.wrapping_byte_add(128).cast::<LadsOptions>();
    let list = inside.cast::<f32>();
    let mut made = null_mut();
    let made = &raw mut made;
    // SAFETY: all of it is alive; the lists are as long as an action.
    unsafe {
        inside.write(options);
        let init = |options| lads_controller_init(policy, memory, bytes, options, made, null_mut());
        assert_eq!(init(inside), Status::Overlap);
        list.write(1.0);
        list.add(1).write(1.0);
        for place in 0..4 {
            let lists = [0, 1, 2, 3].map(|i| {
                if i == place {
                    list.cast_const()
                } else {
                    null()
                }
            });
            [
                options.min,
                options.max,
                options.max_rate,
                options.safe_action,
            ] = lists;
            assert_eq!(init(&raw const options), Status::Overlap);
        }
        [
            options.min,
            options.max,
            options.max_rate,
            options.safe_action,
        ] = [null(); 4];
        let made = memory.cast();
        let refused =
            lads_controller_init(policy, memory, bytes, &raw const options, made, null_mut());
        assert_eq!(refused, Status::Overlap);
        let report = memory.cast::<LadsReport>();
        report.write(LadsReport::default());
        let refused = lads_controller_init(
            policy,
            memory,
            bytes,
            &raw const options,
            null_mut(),
            report,
        );
        assert_eq!(refused, Status::Overlap);
        assert_eq!(init(&raw const options), Status::Ok);
    }
}

#[test]
fn what_a_policy_tells_does_not_go_over_it() {
    let host = Host::new(image());
    let policy = (&raw const *host.policy).cast_mut();
    let image = host.image.bytes().as_ptr().cast_mut();
    let image = image.wrapping_add(image.align_offset(8)).wrapping_add(64);
    let bytes = host.image.bytes().len();
    // SAFETY: what is written lies in memory that is alive; the library refuses to write there.
    unsafe {
        for area in [policy.cast::<u8>().wrapping_add(64), image] {
            let kept = area.cast::<u32>().read();
            area.cast::<u32>().write(size_of::<LadsContract>() as u32);
            assert_eq!(lads_policy_contract(policy, area.cast()), Status::Overlap);
            area.cast::<u32>().write(size_of::<LadsElement>() as u32);
            assert_eq!(
                lads_channel_element(policy, 0, 0, area.cast()),
                Status::Overlap
            );
            area.cast::<u32>().write(kept);
            let name = c"observation".as_ptr();
            assert_eq!(
                lads_channel_find(policy, name, 11, area.cast()),
                Status::Overlap
            );
            let mut alike = 0.0_f32;
            let words = [0.5_f32; 4];
            let number = area.cast::<u32>();
            let status =
                lads_instruction_similarity(policy, words.as_ptr(), 4, number, &raw mut alike);
            assert_eq!(status, Status::Overlap);
        }
        let opened = lads_policy_open(host.image.bytes().as_ptr(), bytes, image.cast());
        assert_eq!(opened, Status::Overlap);
        assert_ne!(lads_workspace_bytes(policy), 0);
    }
}

#[test]
fn what_is_missed_counts_without_an_observation() {
    let mut host = Host::new(image());
    let (c, last) = started(&mut host);
    let mut tick = LadsTick {
        missed: 7,
        timestamp: 1,
        ..LadsTick::default()
    };
    let mut action = [f32::NAN; 2];
    let (to, clock) = (action.as_mut_ptr(), &raw mut tick);
    let o = OBSERVATION.as_ptr();
    // SAFETY: all of it is alive.
    unsafe {
        assert_eq!(
            lads_step(c, null(), 0, clock, to, 2, null_mut()),
            Status::NoObservation
        );
        assert_eq!((action, counters(c).missed), (last, 7));
        let odd = o.wrapping_byte_add(1);
        assert_eq!(
            lads_step(c, odd, 3, clock, to, 2, null_mut()),
            Status::Misaligned
        );
        assert_eq!(counters(c).missed, 14);
    }
}

#[test]
fn an_action_is_written_whatever_is_wrong_with_clock_and_report() {
    let mut host = Host::new(image());
    let (c, last) = started(&mut host);
    let mut action = [f32::NAN; 2];
    let o = OBSERVATION.as_ptr();
    let mut memory = Shared([0; 512]);
    let odd = (&raw mut memory).wrapping_byte_add(1);
    let unset = &raw mut memory;
    let mut wrong = |tick: *const LadsTick, report: *mut LadsReport, expected| {
        action = [f32::NAN; 2];
        // SAFETY: the memory is alive.
        let status = unsafe { lads_step(c, o, 3, tick, action.as_mut_ptr(), 2, report) };
        assert_eq!((status, action), (expected, last));
    };
    wrong(odd.cast(), null_mut(), Status::Misaligned);
    wrong(null(), odd.cast(), Status::Misaligned);
    wrong(unset.cast(), null_mut(), Status::StructBytes);
    wrong(null(), unset.cast(), Status::StructBytes);
    // The report says what is wrong with the clock.
    let mut report = LadsReport::default();
    wrong(unset.cast(), &raw mut report, Status::StructBytes);
    assert_eq!(
        (report.status, report.stepped),
        (Status::StructBytes as i32, 0)
    );
    assert_eq!(counters(c).no_observation, 5);
}
