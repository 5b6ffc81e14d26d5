//! Tests that another image takes the place of the running one, through C.

use core::ptr::null_mut;

use crate::host::support::assemble::ACTION;
use crate::host::support::{Image, Random, shapes};
use crate::host::*;
use lads_ffi::*;

/// Largest change per second; a control period takes 0.08 s.
const RATE: [f32; 2] = [0.5, 0.25];

fn set_up(host: &mut Host, tests: bool, instructs: bool) -> *mut LadsController {
    let (status, c) = host.init(&LadsOptions {
        fallback: LADS_FALLBACK_HOLD,
        max_rate: RATE.as_ptr(),
        ..LadsOptions::default()
    });
    assert_eq!(status, Status::Ok);
    if tests {
        // SAFETY: the controller is alive.
        let status = unsafe { lads_self_test(c, null_mut()) };
        assert_eq!(status, Status::Ok);
    }
    if instructs {
        instruct(c, 0);
    }
    c
}

fn swap(running: *mut LadsController, next: *mut LadsController) -> (Status, u32) {
    let mut report = LadsReport::default();
    // SAFETY: both controllers are alive, or null.
    let status = unsafe { lads_swap(running, next, &raw mut report) };
    (status, report.channel)
}

/// Returns the actions of some steps, each taken after `between` runs.
fn run(image: &Image, between: impl Fn(*mut LadsController, usize)) -> Vec<[f32; 2]> {
    let mut host = Host::new(image.clone());
    let c = set_up(&mut host, true, true);
    let mut random = Random(9);
    let mut actions = Vec::new();
    for t in 0..12 {
        between(c, t);
        let mut action = [0.0; 2];
        assert_eq!(step(c, &random.vec(3, 1.0), &mut action).0, Status::Ok);
        actions.push(action);
    }
    actions
}

#[test]
fn what_does_not_fit_is_refused_and_the_old_policy_goes_on() {
    let old = lads(11).image();
    let mut period = lads(12);
    period.contract.control_period_s = 0.04;
    let mut limits = lads(12);
    limits.elements[4].max = 0.5;
    let other = shapes::recurrent().with_golden(4);
    let sound = lads(12);
    let undisturbed = run(&old, |_, _| ());
    let mut tried = 0;
    for (parts, instructs, expected) in [
        (&period, true, (Status::SwapControlPeriod, LADS_NONE)),
        (&limits, true, (Status::SwapChannels, ACTION)),
        (&other, true, (Status::SwapChannels, 0)),
        (&sound, false, (Status::SwapInstruction, LADS_NONE)),
    ] {
        let image = parts.image();
        let disturbed = run(&old, |running, t| {
            if t == 5 {
                let mut host = Host::new(image.clone());
                let (_, next) = host.init(&LadsOptions::default());
                if instructs {
                    instruct(next, 0);
                }
                assert_eq!(swap(running, next), expected);
                // What was refused is still there.
                assert_eq!(counters(next).periods, 0);
            }
        });
        assert_eq!(disturbed, undisturbed);
        tried += 1;
    }
    assert_eq!(tried, 4);
    run(&old, |running, _| {
        assert_eq!(swap(running, running).0, Status::Overlap);
        assert_eq!(swap(running, null_mut()).0, Status::Null);
        assert_eq!(swap(null_mut(), running).0, Status::Null);
    });
}

#[test]
fn the_new_policy_goes_on_from_the_last_action_and_the_old_workspace_is_free() {
    let (first, second) = (lads(11).image(), lads(12).image());
    let mut hosts = [Host::new(first), Host::new(second)];
    let [one, two] = &mut hosts;
    let mut running = set_up(one, true, true);
    let mut random = Random(2);
    let mut last = [0.0_f32; 2];
    let mut held_back = 0;
    for t in 0..60 {
        if t % 10 == 5 {
            // The idle controller is set up anew while the other runs, and takes over.
            let idle = if running.cast() == one.memory() {
                &mut *two
            } else {
                &mut *one
            };
            let next = set_up(idle, true, true);
            assert_eq!(swap(running, next), (Status::Ok, LADS_NONE));
            assert_eq!(step(running, &[0.0; 3], &mut [0.0; 2]).0, Status::NotSetUp);
            running = next;
        }
        let mut action = [0.0; 2];
        let (status, report) = step(running, &random.vec(3, 1.0), &mut action);
        assert_eq!(status, Status::Ok);
        if t % 10 == 5 {
            assert_eq!((report.timestep, report.fresh), (0, 1), "a new episode");
            held_back += report.rate_limited;
        }
        for ((now, before), rate) in action.iter().zip(last).zip(RATE) {
            let most = f64::from(rate) * f64::from(0.08_f32);
            assert!(
                (f64::from(*now) - f64::from(before)).abs() <= most,
                "step {t}"
            );
        }
        last = action;
    }
    assert!(held_back > 0, "a swap that asks for no jump proves nothing");
    // The counters continue over all of them.
    assert_eq!(
        (counters(running).periods, counters(running).policy),
        (60, 60)
    );
}

#[test]
fn an_untested_policy_does_not_move_anything() {
    let (first, second) = (lads(11).image(), lads(12).image());
    let (mut one, mut two) = (Host::new(first), Host::new(second));
    let running = set_up(&mut one, true, true);
    let mut action = [0.0; 2];
    assert_eq!(step(running, &[0.5; 3], &mut action).0, Status::Ok);
    let next = set_up(&mut two, false, true);
    assert_eq!(swap(running, next).0, Status::Ok);
    assert_eq!(step(next, &[0.5; 3], &mut action).0, Status::NotArmed);
}
