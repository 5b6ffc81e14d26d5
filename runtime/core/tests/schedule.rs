//! Every rule about states, entries, ports and calls, violated once in an image that is sound otherwise.

mod support;

use lads_core::{PolicyError, ScheduleError};
use lads_image::Fault;
use lads_image::op::{Copy, IntSlot, Op, Place, Span};
use lads_image::records::{self, Event, Fill, Repeat, Scope, SourceKind, When};
use support::assemble::{
    self, ACT, ACTION, CONTEXT, DECIDE, ENCODE, INSTRUCT, LOGITS, LOOKUP, OBSERVATION, PLAN, START,
};
use support::draft::{Draft, bound};
use support::shapes::{self, MEMORY};
use support::writer::{Call, Parts, counted_work};
use support::{Model, Spec};

fn lads() -> Parts {
    assemble::parts(&Model::random(Spec::TINY, 11))
}

/// Calls of [`lads`], by their number.
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

fn input(entry: usize, port: u32) -> Option<ScheduleError> {
    Some(ScheduleError::Port {
        entry: entry as u32,
        port,
        output: false,
    })
}

fn output(entry: usize, port: u32) -> Option<ScheduleError> {
    Some(ScheduleError::Port {
        entry: entry as u32,
        port,
        output: true,
    })
}

#[test]
fn states_lie_one_behind_the_other_and_last_as_their_kind_can() {
    let sound = lads();
    let history = shapes::history();
    assert_eq!(sound.fault(|_| ()), None);
    // Two states in the same place, a gap, a place that overflows.
    for offset in [0, 4, 6, u32::MAX] {
        assert_eq!(
            sound.fault(|parts| parts.states[PLAN as usize].offset = offset),
            state(PLAN)
        );
    }
    assert_eq!(history.fault(|parts| parts.states[1].offset -= 1), state(1));
    assert_eq!(history.fault(|parts| parts.states[0].width = 0), state(0));
    assert_eq!(history.fault(|parts| parts.states[0].rows = 0), state(0));
    assert_eq!(
        history.fault(|parts| parts.states[0].rows = u32::MAX),
        state(0)
    );
    assert_eq!(
        sound.fault(|parts| parts.states[PLAN as usize].rows = 2),
        state(PLAN)
    );
    assert_eq!(
        sound.fault(|parts| parts.states[PLAN as usize].fill = Fill::First),
        state(PLAN)
    );
    assert_eq!(
        sound.fault(|parts| parts.states[CONTEXT as usize].fill = Fill::First),
        state(CONTEXT)
    );
    for scope in [Scope::Step, Scope::Instruction] {
        assert_eq!(
            sound.fault(|parts| parts.states[CONTEXT as usize].scope = scope),
            state(CONTEXT)
        );
    }
    assert_eq!(
        history.fault(|parts| parts.states[0].scope = Scope::Step),
        state(0)
    );
    let name = sound.states[LOGITS as usize].name;
    assert_eq!(
        sound.fault(|parts| parts.states[PLAN as usize].name = name),
        state(PLAN)
    );
    // Rings and caches come first.
    let late = |parts: &mut Parts| {
        parts.ring("late", 1, 1, Fill::Zero);
    };
    assert_eq!(sound.sealed_fault(late), state(3));
    let many = sound.sealed_fault(|parts| {
        for i in 0..70 {
            parts.plain(&format!("state {i}"), Scope::Episode, 1);
        }
    });
    assert_eq!(many, Some(ScheduleError::TooMany));
    let unused = sound.sealed_fault(|parts| {
        parts.plain("unused", Scope::Episode, 1);
    });
    assert_eq!(unused, state(3));
    let rings = shapes::window(Fill::Zero).sealed_fault(|parts| {
        for i in 0..records::MAX_ROW_STATES {
            parts.ring(&format!("ring {i}"), 1, 1, Fill::Zero);
        }
    });
    assert_eq!(rings, state(8));
}

#[test]
fn entries_are_programs_with_a_cache_if_they_append() {
    let sound = lads();
    let entry = |entry: usize| {
        Some(ScheduleError::Entry {
            entry: entry as u32,
        })
    };
    assert_eq!(
        sound.fault(|parts| parts.entries[ACT].ops.clear()),
        entry(ACT)
    );
    let empty = sound.sealed_fault(|parts| {
        let unused = Draft::new("nothing").finish();
        parts.entry(unused);
    });
    assert_eq!(empty, entry(7));
    for cache in [PLAN, 3, u32::MAX - 1] {
        assert_eq!(
            sound.fault(|parts| parts.entries[START].cache = cache),
            entry(START)
        );
    }
    // A cache without tokens, and tokens without a cache.
    assert_eq!(
        sound.fault(|parts| parts.entries[ACT].cache = CONTEXT),
        entry(ACT)
    );
    assert_eq!(
        sound.fault(|parts| parts.entries[ACT].tokens = 1),
        entry(ACT)
    );
    let bare = sound.fault(|parts| parts.entries[START].cache = records::NONE);
    assert_eq!(bare, fault_of_program(START, Fault::Bounds));
    assert_eq!(
        sound.fault(|parts| parts.entries[START].tokens = 2),
        fault_of_program(START, Fault::Tokens)
    );
    for more in [1, u32::MAX / 2] {
        for at in [INSTRUCT, ACT, ENCODE] {
            assert_eq!(
                sound.fault(|parts| parts.entries[at].arena_len += more),
                fault_of_program(at, Fault::Arena)
            );
        }
    }
}

fn fault_of_program(at: usize, expected: Fault) -> Option<ScheduleError> {
    Some(ScheduleError::Program {
        entry: at as u32,
        error: lads_image::ProgramError {
            op: expected_op(expected),
            fault: expected,
        },
    })
}

/// Which op of the small policy's programs has the fault; `None` for the arena's.
fn expected_op(fault: Fault) -> Option<u32> {
    match fault {
        Fault::Tokens | Fault::Bounds => Some(6),
        _ => None,
    }
}

#[test]
fn a_cache_is_as_large_as_what_its_programs_use() {
    let sound = lads();
    for more in [1, 16, 1 << 20, 1 << 28] {
        let larger = sound.sealed_fault(|parts| parts.states[CONTEXT as usize].width += more);
        assert_eq!(larger, state(CONTEXT), "{more}");
    }
    let smaller = sound.sealed_fault(|parts| parts.states[CONTEXT as usize].width -= 1);
    assert!(
        matches!(smaller, Some(ScheduleError::Program { error, .. }) if error.fault == Fault::Bounds),
        "{smaller:?}"
    );
}

#[test]
fn ports_are_as_long_as_what_they_are_bound_to() {
    let sound = lads();
    let rebind = |entry: usize, port: usize, kind, of| {
        sound.fault(|parts| parts.entries[entry].inputs[port].0 = bound(kind, of))
    };
    // Nothing of that number; another length; a state of another kind.
    for (kind, of) in [
        (SourceKind::Channel, 5),
        (SourceKind::Channel, u32::MAX),
        (SourceKind::Channel, ACTION),
        (SourceKind::State, PLAN),
        (SourceKind::State, 3),
        (SourceKind::State, CONTEXT),
        (SourceKind::Row, LOGITS),
        (SourceKind::Row, CONTEXT),
        (SourceKind::Timestep, 0),
        (SourceKind::Selected, 0),
        (SourceKind::Pass, 0),
        (SourceKind::Phase, 3),
    ] {
        let expected = if (kind, of) == (SourceKind::State, PLAN) {
            None
        } else {
            input(ACT, 0)
        };
        assert_eq!(rebind(ACT, 0, kind, of), expected, "{kind:?} {of}");
    }
    // An integer that nothing feeds.
    for (kind, of) in [
        (SourceKind::Channel, OBSERVATION),
        (SourceKind::State, PLAN),
        (SourceKind::Row, 0),
        (SourceKind::Phase, 0),
        (SourceKind::Timestep, 1),
        (SourceKind::Pass, 1),
        (SourceKind::Selected, 1),
    ] {
        assert_eq!(
            rebind(LOOKUP, 0, kind, of),
            input(LOOKUP, 0),
            "{kind:?} {of}"
        );
    }
    let camera = shapes::camera();
    let gear = |of| camera.fault(|parts| parts.entries[0].inputs[2].0.of = of);
    assert_eq!(
        [gear(shapes::CAMERA), gear(shapes::TICKS), gear(0)],
        [input(0, 2); 3]
    );
    // Outputs go to the action and to states as a whole or as a row.
    let reroute = |entry: usize, kind, of| {
        sound.fault(|parts| parts.entries[entry].outputs[0].0 = bound(kind, of))
    };
    for (kind, of) in [
        (SourceKind::Channel, OBSERVATION),
        (SourceKind::Channel, 7),
        (SourceKind::State, PLAN),
        (SourceKind::State, CONTEXT),
        (SourceKind::Row, 0),
        (SourceKind::Selected, 0),
        (SourceKind::Timestep, 0),
    ] {
        assert_eq!(reroute(ACT, kind, of), output(ACT, 0), "{kind:?} {of}");
    }
    for (kind, of) in [
        (SourceKind::State, PLAN),
        (SourceKind::Pass, 0),
        (SourceKind::Channel, ACTION),
    ] {
        assert_eq!(
            reroute(ENCODE, kind, of),
            output(ENCODE, 0),
            "{kind:?} {of}"
        );
    }
    let history = shapes::history();
    let whole = history.fault(|parts| parts.entries[2].inputs[0].0.kind = SourceKind::State);
    assert_eq!(whole, input(2, 0));
    // A port outside the arena.
    let outside = Place::Span(Span {
        offset: 1 << 20,
        len: 3,
    });
    let refused = sound.fault(|parts| parts.entries[ACT].inputs[0].1 = outside);
    let bounds = lads_image::ProgramError {
        op: None,
        fault: Fault::Bounds,
    };
    assert_eq!(
        refused,
        Some(ScheduleError::Program {
            entry: ACT as u32,
            error: bounds
        })
    );
}

#[test]
fn calls_do_what_their_event_allows() {
    let sound = lads();
    let edit =
        |at: usize, edit: &dyn Fn(&mut Call)| sound.fault(|parts| edit(&mut parts.calls[at]));
    assert_eq!(edit(LAST, &|c| c.record.entry = 7), call(LAST));
    // A chain that begins with otherwise.
    assert_eq!(edit(FIRST, &|c| c.record.otherwise = true), call(FIRST));
    // Periods where there are none, and none where they are.
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
    // Rows of what is no ring.
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
    let scratch = with_scratch();
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

/// The denoising policy: its state 1 lasts a step.
fn with_scratch() -> Parts {
    shapes::denoise()
}

#[test]
fn what_is_read_was_written_before() {
    let scratch = with_scratch();
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
        act.to_channel(shapes::ACTION, doubled);
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
    // The instruction's rows are as many as its words, and nothing stands behind them.
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
    // Three products of two elements and the four ops around them; a gathered row and its op; one more per op.
    let work = queue.contract.worst_work;
    assert_eq!(work, 6 + 6 + 1);
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
    let per_run = 7 * 2 - 2 * 2 + 8 - 1;
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

/// An image of some megabytes must not take hours to open.
#[test]
fn a_schedule_is_no_longer_than_can_be_gone_through() {
    let memoryless = shapes::memoryless();
    let many = Some(ScheduleError::TooMany);
    let calls = memoryless.fault(|parts| {
        parts.contract.context_steps = 1 << 14;
        let long = parts.entries[0].ops[1].clone();
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

#[test]
fn slots_and_spans_of_ports_may_be_shared() {
    // Two inputs in one place: the second one counts. An output that is an input.
    let shared = shapes::memoryless().sealed_fault(|parts| {
        let place = parts.entries[0].inputs[0].1;
        parts.entries[0].outputs[0].1 = place;
        let port = (bound(SourceKind::Channel, shapes::ACTION), place);
        parts.entries[0].inputs.push(port);
        parts.entries[0]
            .inputs
            .push((bound(SourceKind::Pass, 0), Place::Int(IntSlot(0))));
    });
    assert_eq!(shared, None);
}

#[test]
fn a_program_that_is_not_well_formed_is_named() {
    let window = shapes::window(Fill::Zero);
    let refused = window.fault(|parts| {
        let y = Span { offset: 0, len: 0 };
        let copy = Copy {
            x: y.into(),
            y,
            dims: [1; 4],
            x_strides: [0; 4],
            y_strides: [0; 4],
        };
        parts.entries[1].ops.push(Op::from(copy));
    });
    let error = lads_image::ProgramError {
        op: Some(4),
        fault: Fault::Bounds,
    };
    assert_eq!(refused, Some(ScheduleError::Program { entry: 1, error }));
}
