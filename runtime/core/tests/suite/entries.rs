//! Tests of every rule about states, entries and ports, violated once in an image that is sound
//! otherwise.
#![expect(
    clippy::unnecessary_wraps,
    reason = "what is refused is compared with nothing or an error"
)]

use crate::support::assemble::{
    self, ACT, ACTION, CONTEXT, ENCODE, INSTRUCT, LOGITS, LOOKUP, OBSERVATION, PLAN, START,
};
use crate::support::draft::{Draft, bound};
use crate::support::shapes;
use crate::support::writer::Parts;
use crate::support::{Model, Spec};
use lads_core::ScheduleError;
use lads_image::Fault;
use lads_image::op::{Copy, IntSlot, Op, Place, Span};
use lads_image::records::{self, Fill, Scope, SourceKind};

fn lads() -> Parts {
    assemble::parts(&Model::random(Spec::TINY, 11))
}

fn state(state: u32) -> Option<ScheduleError> {
    Some(ScheduleError::State { state })
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

/// Returns which op of the small policy's programs has the fault; `None` for the arena's.
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
