//! Images that are broken, by accident or on purpose: opening them, and running what opens, gives `Ok` or `Err`, never a panic.

mod support;

use lads_core::image::{CRC_WORD, ProgramKind, Section};
use lads_core::op::{Activation, BinaryKind, CacheFormat, Op, Span};
use lads_core::{Controller, Fault, Instruction, Policy, PolicyError, Workspace};
use proptest::prelude::*;
use support::assemble::{ops_mut, parts, with_golden};
use support::writer::Parts;
use support::{Image, Memory, Model, Spec};

fn sound() -> Parts {
    // Smaller than tiny: every byte of it is flipped.
    let spec = Spec {
        layers: 1,
        hidden: 6,
        head_dim: 3,
        codebook_len: 3,
        plan_len: 2,
        steps: 3,
        horizon: 2,
        ..Spec::TINY
    };
    with_golden(parts(&Model::random(spec, 2)), 4)
}

/// A changed size may ask for more memory than these tests want to give; refusing it is the caller's part.
const MOST: usize = 1 << 16;

/// Uses whatever opens: every call may refuse, none may panic. Memory and time stay small.
fn exercise(bytes: &[u8]) -> bool {
    let Ok(policy) = Policy::new_checked(bytes) else {
        return false;
    };
    policy.checksum_matches();
    let contract = policy.contract();
    contract
        .observations()
        .chain(contract.actions())
        .for_each(drop);
    contract.instructions().for_each(drop);
    let (mut arena, mut state) = (
        vec![0.0; policy.arena_len().min(MOST)],
        vec![0.0; policy.state_len().min(MOST)],
    );
    let Ok(workspace) = Workspace::new(&policy, &mut arena, &mut state) else {
        return true;
    };
    let mut controller = Controller::new(policy, workspace);
    let _ = controller.self_test();
    let _ = controller.set_instruction(Instruction::Id(0));
    let mut action = vec![0.0; contract.action_len().min(MOST)];
    let observation = vec![0.1; contract.observation_len().min(MOST)];
    for _ in 0..8 {
        if controller.step(&observation, &mut action).is_ok() {
            assert!(action.iter().all(|x| x.is_finite()));
            let _ = controller.executed(&action);
        }
    }
    let (o, a) = (contract.observation_len(), contract.action_len());
    let horizon = contract.horizon();
    if (o + a).saturating_mul(horizon) < MOST {
        let _ = controller.encode(&vec![0.1; o * horizon], &vec![0.1; a * horizon]);
    }
    true
}

#[test]
fn every_truncation_is_refused() {
    let image = sound().image();
    assert!(exercise(image.bytes()));
    for len in 0..image.bytes().len() {
        let refused = Policy::new_checked(&image.bytes()[..len]).map(|_| ());
        assert!(
            matches!(refused, Err(PolicyError::Truncated { got, .. }) if got == len),
            "{len}: {refused:?}"
        );
    }
}

#[test]
fn sections_that_overlap_or_change_places_are_refused() {
    let image = sound().image();
    let at = support::writer::section_start;
    let refused = |edit: &dyn Fn(&mut Vec<u32>)| {
        let mut changed = image.clone();
        edit(&mut changed.0);
        Policy::new_checked(changed.bytes()).map(|_| ())
    };
    // The golden section moved into the weights: all of it is still inside the image.
    let moved = refused(&|words| words[at(Section::Golden)] -= 4);
    assert_eq!(moved, Err(PolicyError::Section(Section::Golden)));
    let header = refused(&|words| words[at(Section::Contract)] = 0);
    assert_eq!(header, Err(PolicyError::Section(Section::Contract)));
    let odd = refused(&|words| words[at(Section::Weights) + 1] -= 2);
    assert_eq!(odd, Err(PolicyError::Section(Section::Weights)));
}

#[test]
fn bytes_behind_the_image_are_ignored() {
    let mut image = sound().image();
    image.0.extend([u32::MAX; 5]);
    assert!(image.policy().checksum_matches());
}

#[test]
fn every_flipped_byte_is_found_by_the_checksum_and_never_a_panic() {
    let image = sound().image();
    let mut refused = 0;
    for at in 0..image.bytes().len() {
        for mask in [0x01, 0x80, 0xff] {
            let mut changed = image.clone();
            bytemuck::cast_slice_mut::<u32, u8>(&mut changed.0)[at] ^= mask;
            match Policy::new_checked(changed.bytes()) {
                Ok(policy) => assert!(!policy.checksum_matches(), "byte {at}"),
                Err(_) => refused += 1,
            }
            exercise(changed.bytes());
        }
    }
    // Most of the tables and ops cannot be changed without contradicting something.
    assert!(refused > image.bytes().len() / 2, "{refused} refused");
}

proptest! {
    #[test]
    fn random_words_in_the_tables_never_panic(
        edits in prop::collection::vec((0_usize..10_000, prop_oneof![any::<u32>(), 0_u32..64, Just(u32::MAX)]), 1..6),
    ) {
        let image = sound().image();
        let mut changed = image.clone();
        // Everything before the weights: header, contract, strings, programs, ops.
        let tables = image.0[support::writer::section_start(Section::Weights)] as usize / 4;
        for (at, value) in edits {
            changed.0[at % tables] = value;
        }
        exercise(changed.bytes());
    }

    #[test]
    fn random_bytes_are_no_image(bytes in prop::collection::vec(any::<u32>(), 0..200)) {
        prop_assert!(Policy::new_checked(bytemuck::cast_slice(&bytes)).is_err());
    }
}

#[test]
fn the_header_is_read_first() {
    let image = sound().image();
    let edited = |word: usize, value: u32| {
        let mut changed = image.clone();
        changed.0[word] = value;
        Policy::new_checked(changed.bytes()).map(|_| ())
    };
    assert_eq!(edited(0, 0x1234), Err(PolicyError::Magic));
    assert_eq!(edited(1, 99), Err(PolicyError::Version(99)));
    assert_eq!(edited(2, 3), Err(PolicyError::Length));
    assert!(matches!(
        edited(2, 0x7fff_fffc),
        Err(PolicyError::Truncated {
            needed: 0x7fff_fffc,
            ..
        })
    ));
    assert_eq!(edited(CRC_WORD, 0), Ok(()));
    let bytes = image.bytes();
    let mut shifted = vec![0_u8; bytes.len() + 4];
    let odd = usize::from((shifted.as_ptr() as usize).is_multiple_of(2));
    shifted[odd..odd + bytes.len()].copy_from_slice(bytes);
    let refused = Policy::new_checked(&shifted[odd..odd + bytes.len()]).map(|_| ());
    assert_eq!(refused, Err(PolicyError::Alignment));
}

/// The fault that opening reports after `edit` has changed a program.
fn fault(program: ProgramKind, edit: impl FnOnce(&mut Vec<Op>)) -> Option<Fault> {
    let mut parts = sound();
    edit(ops_mut(&mut parts, program));
    match Policy::new_checked(parts.image().bytes()) {
        Err(PolicyError::Program {
            program: named,
            error,
        }) => {
            assert_eq!(named, program);
            Some(error.fault)
        }
        Err(other) => panic!("{other:?}"),
        Ok(_) => None,
    }
}

/// Edits the first op of a kind.
macro_rules! edit_first {
    ($ops:expr, $kind:ident, $op:ident => $edit:expr) => {
        $ops.iter_mut()
            .find_map(|op| match op {
                Op::$kind($op) => Some($edit),
                _ => None,
            })
            .expect("the program has such an op")
    };
}

#[test]
#[expect(clippy::too_many_lines, reason = "one line per rule")]
fn each_rule_of_an_op_is_enforced() {
    use ProgramKind::{Act, Instruct, Lookup, Start, StepDecide};
    assert_eq!(fault(Act, |_| {}), None);
    let bounds = Some(Fault::Bounds);
    let shape = Some(Fault::Shape);
    let overlap = Some(Fault::Overlap);
    assert_eq!(
        fault(
            Act,
            |ops| edit_first!(ops, Linear, op => op.w.offset = u32::MAX)
        ),
        bounds
    );
    assert_eq!(
        fault(
            Act,
            |ops| edit_first!(ops, Linear, op => op.y.offset = 1 << 20)
        ),
        bounds
    );
    assert_eq!(
        fault(Act, |ops| edit_first!(ops, Linear, op => op.n += 1)),
        shape
    );
    assert_eq!(
        fault(Act, |ops| edit_first!(ops, Linear, op => op.w.len -= 16)),
        shape
    );
    assert_eq!(
        fault(Act, |ops| edit_first!(ops, Linear, op => op.k = 0)),
        shape
    );
    assert_eq!(
        fault(
            Act,
            |ops| edit_first!(ops, Linear, op => op.y.offset = op.x.offset)
        ),
        overlap
    );
    assert_eq!(
        fault(
            Lookup,
            |ops| edit_first!(ops, GatherRow, op => op.rows += 1)
        ),
        shape
    );
    assert_eq!(
        fault(Start, |ops| edit_first!(ops, LayerNorm, op => op.cols = 0)),
        shape
    );
    assert_eq!(
        fault(
            Start,
            |ops| edit_first!(ops, Binary, op => op.b_strides[3] = 2)
        ),
        shape
    );
    assert_eq!(
        fault(
            Start,
            |ops| edit_first!(ops, Binary, op => op.a_strides[3] = 0)
        ),
        overlap
    );
    assert_eq!(
        fault(
            Instruct,
            |ops| edit_first!(ops, Attention, op => op.tokens += 1)
        ),
        Some(Fault::Tokens)
    );
    assert_eq!(
        fault(
            StepDecide,
            |ops| edit_first!(ops, Attention, op => op.cache_k.offset += 1)
        ),
        overlap
    );
    assert_eq!(
        fault(
            StepDecide,
            |ops| edit_first!(ops, Attention, op => op.cache_v.offset += 1)
        ),
        bounds
    );
    assert_eq!(
        fault(
            StepDecide,
            |ops| edit_first!(ops, Attention, op => op.scratch.len -= 1)
        ),
        shape
    );
    assert_eq!(
        fault(
            StepDecide,
            |ops| edit_first!(ops, Attention, op => op.scratch.offset = op.y.offset)
        ),
        overlap
    );
    assert_eq!(
        fault(
            StepDecide,
            |ops| edit_first!(ops, Attention, op => op.heads = 0)
        ),
        shape
    );
    let onto_keys = |ops: &mut Vec<Op>| {
        edit_first!(ops, Attention, op => op.scratch.offset = op.k.offset);
    };
    assert_eq!(fault(StepDecide, onto_keys), overlap);
    let shrink = |ops: &mut Vec<Op>| {
        edit_first!(ops, Attention, op => {
            let width = op.heads * op.head_dim;
            op.cache_v.len -= width;
            let capacity = (op.cache_v.len / width) as usize;
            op.cache_k.len = lads_kernels::keys_len(capacity, width as usize) as u32;
        });
    };
    assert_eq!(fault(StepDecide, shrink), Some(Fault::Capacity));
    let halved = |spare: u32| {
        fault(StepDecide, |ops| {
            edit_first!(ops, Attention, op => {
                op.format = CacheFormat::F16;
                op.cache_k.len = op.cache_k.len.div_ceil(2);
                op.cache_v.len = op.cache_v.len.div_ceil(2) - spare;
            });
        })
    };
    assert_eq!(halved(0), None);
    assert_eq!(halved(1), shape);
}

#[test]
#[expect(clippy::too_many_lines, reason = "one line per rule")]
fn each_rule_of_the_ops_that_the_tiny_policy_does_without() {
    use lads_core::op::{
        Copy, MatMul, Operand, Reduce, ReduceKind, Softmax, Space, Unary, UnaryKind,
    };
    // Two spans of the arena of `act` that are there anyway: 5 and 6 elements long, apart from each other.
    let (x, y) = (Span { offset: 0, len: 4 }, Span { offset: 4, len: 2 });
    let with = |op: Op| fault(ProgramKind::Act, move |ops| ops.insert(0, op));
    let reduce = Reduce {
        kind: ReduceKind::Sum,
        x: x.into(),
        y,
        outer: 2,
        axis: 2,
        inner: 1,
    };
    assert_eq!(with(reduce.into()), None);
    assert_eq!(
        with(Reduce { axis: 3, ..reduce }.into()),
        Some(Fault::Shape)
    );
    assert_eq!(
        with(
            Reduce {
                y: Span { offset: 3, len: 2 },
                ..reduce
            }
            .into()
        ),
        Some(Fault::Overlap)
    );
    let (unit, row) = ([1, 1, 1, 2], [0, 0, 0, 1]);
    let copy = Copy {
        x: x.into(),
        y,
        dims: unit,
        x_strides: [0, 0, 0, 3],
        y_strides: row,
    };
    assert_eq!(with(copy.into()), None);
    assert_eq!(
        with(
            Copy {
                x_strides: [0, 0, 0, 4],
                ..copy
            }
            .into()
        ),
        Some(Fault::Shape)
    );
    assert_eq!(
        with(
            Copy {
                y_strides: [0; 4],
                ..copy
            }
            .into()
        ),
        Some(Fault::Shape)
    );
    let broadcast = Copy {
        dims: [1, 1, u32::MAX, 2],
        ..copy
    };
    assert_eq!(with(broadcast.into()), Some(Fault::Shape));
    assert_eq!(
        with(
            Softmax {
                x: y,
                y: x,
                rows: 1,
                cols: 2
            }
            .into()
        ),
        Some(Fault::Shape)
    );
    assert_eq!(
        with(
            Softmax {
                x,
                y: x,
                rows: 1,
                cols: 4
            }
            .into()
        ),
        Some(Fault::Overlap)
    );
    let unary = Unary {
        kind: UnaryKind::Exp,
        alpha: 0.0,
        x: y.into(),
        y,
    };
    assert_eq!(with(unary.into()), None);
    assert_eq!(
        with(
            Unary {
                x: Span { offset: 5, len: 2 }.into(),
                ..unary
            }
            .into()
        ),
        Some(Fault::Overlap)
    );
    let product = MatMul {
        a: x.into(),
        b: Operand {
            space: Space::Weights,
            offset: 0,
            len: 2,
        },
        y,
        batch: 1,
        m: 2,
        k: 2,
        n: 1,
        a_strides: [0, 2, 1],
        b_strides: [0, 1, 1],
    };
    assert_eq!(with(product.into()), None);
    assert_eq!(with(MatMul { k: 3, ..product }.into()), Some(Fault::Shape));
    let endless = MatMul {
        k: u32::MAX,
        a_strides: [0; 3],
        b_strides: [0; 3],
        ..product
    };
    assert_eq!(with(endless.into()), Some(Fault::Shape));
    let linear =
        |ops: &mut Vec<Op>| edit_first!(ops, Linear, op => op.activation = Activation::Tanh);
    assert_eq!(fault(ProgramKind::Act, linear), None);
    let add = |ops: &mut Vec<Op>| edit_first!(ops, Binary, op => op.kind = BinaryKind::Max);
    assert_eq!(fault(ProgramKind::Start, add), None);
}

#[test]
fn a_missing_program_or_port_is_named() {
    for kind in [
        ProgramKind::Instruct,
        ProgramKind::StepRecord,
        ProgramKind::Act,
    ] {
        let mut parts = sound();
        parts.programs[kind as usize] = support::writer::empty_program();
        let refused = Policy::new_checked(parts.image().bytes()).map(|_| ());
        assert_eq!(refused, Err(PolicyError::Missing(kind)));
    }
    let mut parts = sound();
    parts.programs[ProgramKind::Act as usize].0.outputs_len = 0;
    let refused = Policy::new_checked(parts.image().bytes()).map(|_| ());
    assert!(
        matches!(
            refused,
            Err(PolicyError::Program {
                program: ProgramKind::Act,
                ..
            })
        ),
        "{refused:?}"
    );
    let mut parts = sound();
    parts.contract.observation_len += 1;
    assert!(Policy::new_checked(parts.image().bytes()).is_err());
}

#[test]
fn an_image_cannot_ask_for_memory_that_it_does_not_use() {
    for kind in [ProgramKind::Instruct, ProgramKind::Act, ProgramKind::Encode] {
        for more in [1, u32::MAX / 2] {
            let mut parts = sound();
            parts.programs[kind as usize].0.arena_len += more;
            let refused = Policy::new_checked(parts.image().bytes()).map(|_| ());
            assert!(
                matches!(refused, Err(PolicyError::Program { program, error })
                    if program == kind && error.fault == Fault::Arena),
                "{refused:?}"
            );
        }
    }
    for more in [1, u32::MAX / 2] {
        let mut parts = sound();
        parts.contract.cache_len += more;
        let refused = Policy::new_checked(parts.image().bytes()).map(|_| ());
        assert_eq!(refused, Err(PolicyError::Cache));
    }
}

#[test]
fn a_timestep_beyond_the_table_is_an_error_of_the_step() {
    let mut parts = sound();
    // The table of timesteps is read one row too far: the last step of a context has no row.
    let ops = ops_mut(&mut parts, ProgramKind::StepRecord);
    let edited = ops.iter_mut().filter_map(|op| match op {
        Op::GatherRow(op) => Some(op),
        _ => None,
    });
    edited.for_each(|op| op.shift += 5);
    let image: Image = parts.image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    controller
        .set_instruction(Instruction::Id(0))
        .expect("the instruction is known");
    let mut action = [0.0; 2];
    assert!(controller.step(&[0.0; 3], &mut action).is_ok());
    let before = action;
    let refused = controller.step(&[0.0; 3], &mut action);
    assert!(
        matches!(refused, Err(lads_core::StepError::Program(_))),
        "{refused:?}"
    );
    assert_eq!(action, before);
}
