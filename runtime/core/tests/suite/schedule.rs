//! Tests of every rule about calls and the steps that they make, violated once in an image that is
//! sound otherwise.
#![expect(
    clippy::unnecessary_wraps,
    reason = "what is refused is compared with nothing or an error"
)]

use crate::support::assemble::{self, ACT, CONTEXT, DECIDE, ENCODE, INSTRUCT, LOGITS, PLAN, START};
use crate::support::draft::Draft;
use crate::support::shapes::{self, MEMORY};
use crate::support::writer::{Call, Parts, counted_work};
use crate::support::{Model, Spec};
use lads_core::{PolicyError, ScheduleError};
use lads_image::records::{self, Event, Fill, Repeat, Scope, When};

fn lads() -> Parts {
    assemble::parts(&Model::random(Spec::TINY, 11))
}

/// Numbers of the calls of [`lads`].
const FIRST: usize = 1;
const LOOK: usize = 4;
const LAST: usize = 5;
const FOLLOW: usize = 6;
const FOLLOW_ACT: usize = 7;
const TO_INDEX: usize = 8;

fn state(state: u32) -> Option<ScheduleError> {
    Some(ScheduleError::State { state })
}

fn call(call: usize) -> Option<ScheduleError> {
    Some(ScheduleError::Call { call: call as u32 })
}

#[test]
fn calls_do_what_their_event_allows() {
    let sound = lads();
    let edit =
        |at: usize, edit: &dyn Fn(&mut Call)| sound.fault(|parts| edit(&mut parts.calls[at]));
    assert_eq!(edit(LAST, &|c| c.record.entry = 7), call(LAST));
    // A chain that begins with otherwise.
    assert_eq!(edit(FIRST, &|c| c.record.otherwise = true), call(FIRST));
    // A period where none is allowed, and none where one is required.
    assert_eq!(edit(LAST, &|c| c.record.every = 2), call(LAST));
    assert_eq!(edit(LOOK, &|c| c.record.every = 0), call(LOOK));
    assert_eq!(edit(FIRST, &|c| c.record.every = 1), call(FIRST));
    for count in [0, (1 << 16) + 1, u32::MAX] {
        assert_eq!(
            edit(LAST, &|c| c.record.count = count),
            call(LAST),
            "{count}"
        );
    }
    // Rows of a state that is not a ring.
    for ring in [CONTEXT, PLAN, 9] {
        assert_eq!(
            edit(LAST, &|c| (c.record.repeat, c.record.count) =
                (Repeat::Rows, ring)),
            call(LAST)
        );
    }
    assert_eq!(edit(FIRST, &|c| c.record.select = 3), call(FIRST));
    assert_eq!(edit(FIRST, &|c| c.record.select = CONTEXT), call(FIRST));
    // Two kinds of scores.
    assert_eq!(edit(LOOK, &|c| c.record.select = PLAN), call(LOOK));
    assert_eq!(edit(LAST, &|c| c.clears.push(9)), call(LAST));
    let scratch = shapes::denoise();
    assert_eq!(
        scratch.fault(|parts| parts.calls[0].clears.push(1)),
        call(0)
    );
    // Only a step has conditions, repeats, selections and clears.
    for at in [0, FOLLOW_ACT, TO_INDEX] {
        for wrong in [
            |c: &mut Call| c.record.when = When::First,
            |c: &mut Call| (c.record.when, c.record.every) = (When::Every, 1),
            |c: &mut Call| c.record.otherwise = true,
            |c: &mut Call| c.record.count = 2,
            |c: &mut Call| c.record.select = LOGITS,
            |c: &mut Call| c.clears.push(PLAN),
        ] {
            assert_eq!(edit(at, &wrong), call(at));
        }
    }
    // Calls of an event stand together.
    assert_eq!(sound.fault(|parts| parts.calls.swap(0, 1)), call(1));
    // What each event may read.
    assert_eq!(edit(0, &|c| c.record.entry = ACT as u32), call(0));
    assert_eq!(
        edit(LAST, &|c| c.record.entry = INSTRUCT as u32),
        call(LAST)
    );
    assert_eq!(edit(LAST, &|c| c.record.entry = ENCODE as u32), call(LAST));
    assert_eq!(
        edit(TO_INDEX, &|c| c.record.entry = ACT as u32),
        call(TO_INDEX)
    );
    // No timestep, no previous action and no cache beside the episode.
    for entry in [START, DECIDE] {
        assert_eq!(
            edit(FOLLOW, &|c| c.record.entry = entry as u32),
            call(FOLLOW)
        );
    }
    let noisy =
        shapes::denoise().sealed_fault(|parts| parts.calls.push(Call::on(Event::Follow, 1)));
    assert_eq!(noisy, call(4));
    // A row is read by a call that runs once per row of that ring.
    let history = shapes::history();
    assert_eq!(
        history.fault(|parts| parts.calls[2] = parts.calls[2].clone().times(1)),
        call(2)
    );
    // Rows are appended one at a time.
    assert_eq!(
        history.fault(|parts| parts.calls[4].record.count = 2),
        call(4)
    );
    let window = shapes::window(Fill::Zero);
    assert_eq!(
        window.sealed_fault(|parts| parts.calls.push(Call::step(0))),
        call(2)
    );
}

#[test]
fn what_is_read_was_written_before() {
    // Its state 1 lasts a step.
    let scratch = shapes::denoise();
    // The action before the denoising; the denoising before its start.
    assert_eq!(
        scratch.sealed_fault(|parts| parts.calls.swap(1, 3)),
        call(1)
    );
    assert_eq!(
        scratch.sealed_fault(|parts| drop(parts.calls.remove(1))),
        call(1)
    );
    // Written at the first step only.
    assert_eq!(
        scratch.sealed_fault(|parts| parts.calls[1] = Call::step(1).first()),
        call(2)
    );
    // An index before one is selected: by order, never, or only later.
    let nothing = Some(ScheduleError::NothingSelected);
    assert_eq!(
        scratch.sealed_fault(|parts| parts.calls.rotate_left(1)),
        nothing
    );
    assert_eq!(
        scratch.sealed_fault(|parts| parts.calls[0].record.select = records::NONE),
        nothing
    );
    let sound = lads();
    let never = |parts: &mut Parts| parts.calls[FIRST].record.select = records::NONE;
    assert_eq!(sound.fault(never), nothing);
    let no_scores = |parts: &mut Parts| {
        parts.calls = vec![Call::step(0), Call::step(1), Call::on(Event::Follow, 1)];
    };
    assert_eq!(shapes::window(Fill::Zero).sealed_fault(no_scores), nothing);
    // Scores outlive the step: they are what the controller shows.
    assert_eq!(
        scratch.sealed_fault(|parts| parts.states[0].scope = Scope::Step),
        call(0)
    );
}

#[test]
fn every_step_writes_an_action() {
    let none = |timestep| Some(ScheduleError::NoAction { timestep });
    let sound = lads();
    assert_eq!(
        sound.sealed_fault(|parts| drop(parts.calls.remove(LAST))),
        none(0)
    );
    assert_eq!(
        sound.sealed_fault(|parts| parts.calls[LAST] = Call::step(ACT as u32).first()),
        none(1)
    );
    assert_eq!(
        sound.sealed_fault(|parts| parts.calls[LAST] = Call::step(ACT as u32).every(3)),
        none(1)
    );
    assert_eq!(
        shapes::queue().sealed_fault(|parts| parts.calls[1] = Call::step(1).every(3)),
        none(1)
    );
    // Once per row of a ring that may be empty.
    let rows = shapes::history().sealed_fault(|parts| {
        let mut act = Draft::new("act");
        let observation = act.channel(shapes::OBSERVATION, 2);
        let doubled = act.add(observation, observation);
        act.gives_channel(shapes::ACTION, doubled);
        let act = parts.entry(act.finish());
        parts.entries[3].outputs.clear();
        parts.calls.insert(3, Call::step(act).rows(0));
    });
    assert_eq!(rows, none(0));
    assert_eq!(
        sound.sealed_fault(|parts| drop(parts.calls.remove(FOLLOW_ACT))),
        none(0)
    );
}

#[test]
fn caches_have_the_rows_that_the_longest_context_needs() {
    let sound = lads();
    let rows = |state, stated, needed| {
        Some(ScheduleError::Rows {
            state,
            stated,
            needed,
        })
    };
    // A longer context overflows it, a shorter one leaves rows over: 4 + 1 + 2 * 7 of 8 steps.
    assert_eq!(
        sound.sealed_fault(|parts| parts.contract.context_steps = 9),
        rows(CONTEXT, 19, 21)
    );
    assert_eq!(
        sound.sealed_fault(|parts| parts.contract.context_steps = 7),
        rows(CONTEXT, 19, 17)
    );
    assert_eq!(
        sound.sealed_fault(|parts| parts.contract.context_steps = 0),
        rows(CONTEXT, 19, 15)
    );
    let chunks = shapes::chunks();
    // Cleared every fourth step: nine rows.
    let seldom = |parts: &mut Parts| parts.calls[3].record.every = 4;
    assert_eq!(chunks.sealed_fault(seldom), rows(1, 5, 8));
    // Cleared twice in a step.
    assert_eq!(
        chunks.sealed_fault(|parts| parts.calls[4].clears.push(1)),
        rows(1, 5, 3)
    );
    let twice = |parts: &mut Parts| parts.calls[3].clears.push(1);
    assert_eq!(chunks.sealed_fault(twice), call(3));
    // What an instruction leaves in a cache is not a call's to clear.
    let words = |parts: &mut Parts| {
        parts.calls[1].clears.push(0);
    };
    assert_eq!(chunks.sealed_fault(words), state(0));
    // The instruction's rows are as many as its words, and no rows follow them.
    assert_eq!(
        chunks.sealed_fault(|parts| parts.calls.insert(0, Call::on(Event::Instruct, 0))),
        call(1)
    );
    // A ring that outlives the context is full when the next one begins.
    let history = shapes::history();
    let capacity = 1 + 2 * MEMORY + 4;
    assert_eq!(history.fault(|_| ()), None);
    let early = |parts: &mut Parts| parts.contract.context_steps = 2;
    assert_eq!(history.sealed_fault(early), rows(1, capacity, 5));
    let outliving = |parts: &mut Parts| {
        early(parts);
        parts.states[0].scope = Scope::Instruction;
    };
    assert_eq!(history.sealed_fault(outliving), None);
}

#[test]
fn work_is_stated_as_it_is_and_limited_by_the_caller() {
    let queue = shapes::queue();
    // Three products of two elements, copied into one row of six; a gathered row of two; one more for each of the seven ops.
    let work = queue.contract.worst_work;
    assert_eq!(work, 6 + 6 + 2 + 7);
    for stated in [0, work - 1, work + 1, u64::MAX] {
        let fault = queue.fault(|parts| parts.contract.worst_work = stated);
        assert_eq!(
            fault,
            Some(ScheduleError::Work {
                stated,
                counted: work
            })
        );
    }
    let image = queue.image();
    let within = |limit| {
        lads_core::Policy::new_within(image.bytes(), limit)
            .map(|policy| policy.contract().worst_work())
    };
    assert_eq!(within(work), Ok(work));
    assert_eq!(
        within(work - 1),
        Err(PolicyError::Work {
            needed: work,
            limit: work - 1
        })
    );
    // Repeats count as often as they run at most.
    let mut denoise = shapes::denoise();
    let before = counted_work(&denoise);
    denoise.calls[2].record.count = 1 << 16;
    let after = counted_work(&denoise.sealed());
    // Seven ops of two elements each, and one more per op.
    let per_run = 7 * 2 + 7;
    assert_eq!(after - before, ((1 << 16) - 3) * per_run);
    let endless = shapes::denoise().sealed_fault(|parts| parts.calls[2].record.count = u32::MAX);
    assert_eq!(endless, call(2));
}

#[test]
fn a_context_is_no_longer_than_can_be_gone_through() {
    let memoryless = shapes::memoryless();
    for (steps, fault) in [
        (1, None),
        (1 << 14, None),
        ((1 << 14) + 1, Some(ScheduleError::TooMany)),
        (u32::MAX, Some(ScheduleError::TooMany)),
    ] {
        assert_eq!(
            memoryless.sealed_fault(|parts| parts.contract.context_steps = steps),
            fault,
            "{steps}"
        );
    }
    let queue = shapes::queue();
    let period = |period| {
        queue.sealed_fault(|parts| {
            parts.calls[0].record.every = period;
            parts.entries[1].inputs[1].0.of = period;
        })
    };
    assert_eq!(
        [period(1 << 13), period((1 << 13) + 1)],
        [None, Some(ScheduleError::TooMany)]
    );
    // Without an end there is one period, of calls and phases alike.
    assert_eq!(
        queue.sealed_fault(|parts| parts.calls.insert(1, Call::step(0).every(2))),
        call(1)
    );
    assert_eq!(
        queue.sealed_fault(|parts| parts.entries[1].inputs[1].0.of = 2),
        call(1)
    );
}

/// The ops of an entry are counted once, not at each of the steps that run it, so opening takes no
/// minutes.
#[test]
fn long_programs_are_gone_through_once() {
    let many = shapes::memoryless().sealed_fault(|parts| {
        parts.contract.context_steps = 1 << 14;
        let long = parts.entries[0].ops[1];
        parts.entries[0]
            .ops
            .extend(std::iter::repeat_n(long, 20_000));
        parts.calls.extend(std::iter::repeat_n(Call::step(0), 60));
    });
    assert_eq!(many, None);
}

/// An image of some megabytes must not take hours to open.
#[test]
fn a_schedule_is_no_longer_than_can_be_gone_through() {
    let memoryless = shapes::memoryless();
    let many = Some(ScheduleError::TooMany);
    let calls = memoryless.fault(|parts| {
        parts.contract.context_steps = 1 << 14;
        let long = parts.entries[0].ops[1];
        parts.entries[0].ops.extend(std::iter::repeat_n(long, 2000));
        parts.calls.extend(std::iter::repeat_n(Call::step(0), 2000));
    });
    assert_eq!(calls, many);
    let entries = memoryless.fault(|parts| {
        let entry = parts.entries[0].clone();
        parts.entries.extend(std::iter::repeat_n(entry, 2000));
    });
    assert_eq!(entries, many);
    let ports = memoryless.fault(|parts| {
        let port = parts.entries[0].inputs[0];
        parts.entries[0]
            .inputs
            .extend(std::iter::repeat_n(port, 2000));
    });
    assert_eq!(ports, many);
    let clears = shapes::window(Fill::Zero).fault(|parts| parts.calls[0].clears = vec![0; 2000]);
    assert_eq!(clears, many);
}
