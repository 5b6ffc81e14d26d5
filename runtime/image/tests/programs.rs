//! Tests that checking programs that are broken, by accident or on purpose, and running those that
//! pass, gives `Ok` or `Err`, never a panic.

mod support;

use lads_image::op::{INT_SLOTS, OP_WORDS, Op, Place, Span};
use lads_image::{ExecError, Fault, Isa, Machine, Program, ProgramError};
use proptest::prelude::*;
use support::assemble::Draft;
use support::{Assembled, Kind, Runner, sound};

const KINDS: [Kind; 7] = [
    Kind::Instruct,
    Kind::Start,
    Kind::StepDecide,
    Kind::StepRecord,
    Kind::Lookup,
    Kind::Act,
    Kind::Encode,
];

#[test]
fn a_fault_names_its_op() {
    let policy = sound();
    let mut words = policy.encode(Kind::Act);
    words[1][0] = 99;
    let error = policy.check(Kind::Act, &words).map(|_| ()).unwrap_err();
    let expected = ProgramError {
        op: Some(1),
        fault: Fault::Encoding,
    };
    assert_eq!(error, expected);
    assert_eq!(error.to_string(), "op 1: unknown operation");
}

#[test]
fn ports_lie_inside_the_arena_and_the_slots() {
    let with = |place: Place| {
        let mut policy = sound();
        policy.draft_mut(Kind::Act).outputs.push(("more", place));
        let words = policy.encode(Kind::Act);
        policy.check(Kind::Act, &words).map(|_| ())
    };
    let len = sound().draft(Kind::Act).arena_len;
    let refused = Err(ProgramError {
        op: None,
        fault: Fault::Bounds,
    });
    let span = |offset, len| Place::Span(Span { offset, len });
    assert_eq!(with(span(0, len)), Ok(()));
    assert_eq!(with(span(1, len)), refused);
    assert_eq!(with(span(u32::MAX, u32::MAX)), refused);
    assert_eq!(with(span(0, 0)), refused);
    let slot = |slot| Place::Int(lads_image::op::IntSlot(slot));
    assert_eq!(with(slot(INT_SLOTS as u8 - 1)), Ok(()));
    assert_eq!(with(slot(INT_SLOTS as u8)), refused);
}

#[test]
fn a_program_cannot_ask_for_memory_that_it_does_not_use() {
    for kind in [Kind::Instruct, Kind::Act, Kind::Encode] {
        for more in [1, u32::MAX / 2] {
            let mut policy = sound();
            policy.draft_mut(kind).arena_len += more;
            let words = policy.encode(kind);
            let refused = policy.check(kind, &words).map(|_| ());
            let fault = Fault::Arena;
            assert_eq!(refused, Err(ProgramError { op: None, fault }));
        }
    }
}

#[test]
fn the_end_of_the_cache_is_that_of_the_last_attention() {
    let policy = sound();
    for kind in KINDS {
        let words = policy.encode(kind);
        let program = policy.check(kind, &words).expect("the program is sound");
        let knows = program.tokens() > 0;
        let expected = if knows {
            u64::from(policy.cache_len)
        } else {
            0
        };
        assert_eq!(program.cache_end(), expected, "{kind:?}");
        assert_eq!(program.work().state_words > 0, knows, "{kind:?}");
        assert!(!program.is_empty());
    }
}

#[test]
fn work_is_the_sum_of_the_ops() {
    let policy = sound();
    let words = policy.encode(Kind::Act);
    let program = policy.check(Kind::Act, &words).expect("it is sound");
    let (mut products, mut weights) = (0, 0);
    for op in program.ops() {
        let Op::Linear(op) = op else {
            panic!("{op:?} is no layer")
        };
        products += u64::from(op.m * op.k * op.n);
        weights += u64::from(op.w.len + op.n);
    }
    let work = program.work();
    assert_eq!((work.multiply_adds, work.weight_words), (products, weights));
}

#[test]
fn a_timestep_beyond_the_table_is_an_error_of_the_run() {
    let policy = sound();
    let mut runner = Runner::new(&policy);
    let step = |runner: &mut Runner, t: f32| {
        let inputs: [(&str, &[f32]); 3] = [
            ("timestep", &[t]),
            ("observation", &[0.0; 3]),
            ("action", &[0.0; 2]),
        ];
        runner.run(Kind::StepRecord, &inputs)
    };
    assert_eq!(step(&mut runner, 2.0), Ok(()));
    assert_eq!(
        step(&mut runner, 3.0),
        Err(ExecError::Index { row: 3, rows: 3 })
    );
    // The previous action's row is that of the step before.
    assert_eq!(
        step(&mut runner, 0.0),
        Err(ExecError::Index { row: -1, rows: 3 })
    );
}

#[test]
fn a_full_cache_is_an_error_of_the_run() {
    let policy = sound();
    let rows = policy.rows as usize;
    let mut runner = Runner::new(&policy);
    let words = [0.5; 16];
    let inputs: [(&str, &[f32]); 1] = [("words", &words)];
    runner.past = rows - 4;
    assert_eq!(runner.run(Kind::Instruct, &inputs), Ok(()));
    assert_eq!(runner.past, rows);
    runner.past = rows - 3;
    let needed = rows + 1;
    assert_eq!(
        runner.run(Kind::Instruct, &inputs),
        Err(ExecError::Full { rows, needed })
    );
    // Programs without a cache run although the cache is full.
    runner.past = rows;
    assert_eq!(runner.run(Kind::Lookup, &[("plan_index", &[1.0])]), Ok(()));
}

#[test]
fn memory_that_is_too_small_is_an_error_of_the_run() {
    let policy = sound();
    let words = policy.encode(Kind::Start);
    let program = policy.check(Kind::Start, &words).expect("it is sound");
    let run = |arena_len: usize, cache_len: usize, weights_len: usize| {
        let mut machine = Machine {
            arena: &mut vec![0.0; arena_len],
            cache: &mut vec![0.0; cache_len],
            ints: [0; INT_SLOTS],
            past: 0,
            isa: Isa::detect(),
        };
        program.run(&policy.weights[..weights_len], &mut machine)
    };
    let (arena, cache) = (program.arena_len(), policy.cache_len as usize);
    let weights = policy.weights.len();
    assert_eq!(run(arena, cache, weights), Ok(()));
    assert_eq!(run(arena - 1, cache, weights), Err(ExecError::Span));
    assert_eq!(run(arena, cache - 1, weights), Err(ExecError::Span));
    assert_eq!(run(arena, cache, 9), Err(ExecError::Span));
}

/// Runs a program that passes the check, in memory of its size: it may refuse, it may not panic.
fn exercise(policy: &Assembled, draft: &Draft, words: &[[u32; OP_WORDS]]) -> bool {
    let ports = draft.inputs.iter().chain(&draft.outputs);
    let places = ports.map(|&(_, place)| place);
    let Ok(program) = Program::new_checked(
        words,
        draft.arena_len,
        draft.tokens,
        policy.spaces(),
        places,
    ) else {
        return false;
    };
    let mut machine = Machine {
        arena: &mut vec![0.1; program.arena_len()],
        cache: &mut vec![0.1; policy.cache_len as usize],
        ints: [1; INT_SLOTS],
        past: 1,
        isa: Isa::detect(),
    };
    let ran = program.run(&policy.weights, &mut machine);
    assert!(!matches!(ran, Err(ExecError::Span)), "{ran:?}");
    true
}

#[test]
fn every_changed_word_is_refused_or_runs() {
    let policy = sound();
    let (mut refused, mut all) = (0, 0);
    for kind in KINDS {
        let words = policy.encode(kind);
        assert!(exercise(&policy, policy.draft(kind), &words));
        for (i, word) in (0..words.len()).flat_map(|i| (0..OP_WORDS).map(move |word| (i, word))) {
            for mask in [1, 0x80, 0x100, 0x8000_0000, u32::MAX] {
                let mut changed = words.clone();
                changed[i][word] ^= mask;
                refused += usize::from(!exercise(&policy, policy.draft(kind), &changed));
                all += 1;
            }
        }
    }
    // Most words cannot be changed without contradicting something.
    assert!(refused > all / 2, "{refused} of {all} refused");
}

proptest! {
    #[test]
    fn random_words_never_panic(
        kind in prop::sample::select(KINDS.to_vec()),
        edits in prop::collection::vec(
            (any::<prop::sample::Index>(), 0..OP_WORDS, prop_oneof![any::<u32>(), 0_u32..64, Just(u32::MAX)]),
            1..6,
        ),
    ) {
        let policy = sound();
        let mut words = policy.encode(kind);
        for (op, word, value) in edits {
            let op = op.index(words.len());
            words[op][word] = value;
        }
        exercise(&policy, policy.draft(kind), &words);
    }
}
