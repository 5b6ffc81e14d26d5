//! Tests of the memory plan and of the verifier that does not trust it.

use lads_image::op::{Copy, Op, Operand, Place, Space, Span, Unary, UnaryKind};
use proptest::prelude::*;

use crate::bundle::Bundle;
use crate::lower::Lowered;
use crate::plan::{Placed, plan};
use crate::verify::{PlanFault, verify};

/// Returns all programs of the tiny bundle.
fn programs() -> Vec<(Lowered, Placed)> {
    named().into_iter().map(|(_, planned)| planned).collect()
}

/// Returns all programs of the tiny bundle with their names.
fn named() -> Vec<(String, (Lowered, Placed))> {
    let bundle =
        Bundle::from_bytes(include_bytes!("../../tests/data/tiny.onnx")).expect("a bundle");
    super::programs(&bundle, 64)
        .into_iter()
        .map(|program| {
            let super::Compiled {
                lowered, placed, ..
            } = program.compiled;
            (program.entry.name, (lowered, placed))
        })
        .collect()
}

fn offsets(op: &Op) -> Vec<u32> {
    let mut offsets = vec![];
    op.clone().each_span(&mut |span| offsets.push(span.offset));
    offsets
}

/// The verifier notices if any one span of any op is moved, unless nothing changes by it.
#[test]
fn every_moved_span_is_found() {
    for (lowered, placed) in programs() {
        for (i, op) in placed.ops.iter().enumerate() {
            for which in 0..offsets(op).len() {
                for to in [0, 7, 16, 64, placed.arena_len.saturating_sub(8)] {
                    let mut wrong = placed.clone();
                    let mut at = 0;
                    wrong.ops[i].each_span(&mut |span| {
                        if at == which {
                            span.offset = to;
                        }
                        at += 1;
                    });
                    let scratch = matches!(op, Op::Attention(op) if op.queries > 0) && which == 4;
                    if offsets(&wrong.ops[i]) == offsets(op) || scratch {
                        continue;
                    }
                    assert!(
                        verify(&lowered, &wrong).is_err(),
                        "op {i} {op:?}, span {which} to {to}"
                    );
                }
            }
        }
    }
}

#[test]
fn two_live_buffers_in_one_place_are_found() {
    for (lowered, placed) in programs() {
        // Everything at the start of the arena: buffers that live at the same time clash.
        let mut wrong = placed.clone();
        for op in &mut wrong.ops {
            op.each_span(&mut |span| span.offset = 0);
        }
        if lowered.ops.len() > 1 {
            assert!(verify(&lowered, &wrong).is_err());
        }
    }
}

#[test]
fn a_smaller_arena_is_found() {
    for (lowered, mut placed) in programs() {
        placed.arena_len -= 1;
        assert!(matches!(
            verify(&lowered, &placed),
            Err(PlanFault::Bounds { .. })
        ));
    }
}

#[test]
fn a_changed_op_is_found() {
    for (lowered, mut placed) in programs() {
        let last = placed.ops.len() - 1;
        placed.ops.swap(0, last);
        if last > 0 {
            assert!(matches!(
                verify(&lowered, &placed),
                Err(PlanFault::Changed { op: 0 })
            ));
        }
        placed.ops.pop();
        assert!(matches!(
            verify(&lowered, &placed),
            Err(PlanFault::Changed { .. })
        ));
    }
}

#[test]
fn plans_are_near_their_lower_bound() {
    for (name, (_, placed)) in named() {
        let (arena, bound) = (placed.arena_len, placed.lower_bound);
        assert!(
            arena >= bound && arena * 10 <= bound * 11,
            "{name}: {arena} elements, at least {bound}"
        );
    }
}

fn unary(x: Span, y: Span) -> Op {
    Unary {
        kind: UnaryKind::Neg,
        alpha: 0.0,
        x: x.into(),
        y,
    }
    .into()
}

#[test]
fn reads_of_nothing_are_found() {
    let [a, b, c] = [0, 4, 8].map(|offset| Span { offset, len: 4 });
    let program = |ops: Vec<Op>| Lowered {
        ops,
        buffers: vec![a, b, c],
        inputs: vec![("a".into(), Place::Span(a))],
        outputs: vec![("y".into(), Place::Span(c))],
        tokens: 0,
        layers: vec![],
    };
    let sound = program(vec![unary(a, b), unary(b, c)]);
    assert_eq!(verify(&sound, &plan(&sound)), Ok(()));
    let unwritten = program(vec![unary(b, c)]);
    assert!(matches!(
        verify(&unwritten, &plan(&unwritten)),
        Err(PlanFault::Unwritten { op: 0, .. })
    ));
    let no_output = program(vec![unary(a, b)]);
    assert!(matches!(
        verify(&no_output, &plan(&no_output)),
        Err(PlanFault::Unwritten { op: 1, .. })
    ));
    // Every other element of the output stays unwritten, though its span is named.
    let x = Operand {
        space: Space::Arena,
        offset: 0,
        len: 2,
    };
    let half = Copy {
        x,
        y: c,
        dims: [1, 1, 1, 2],
        x_strides: [0, 0, 0, 1],
        y_strides: [0, 0, 0, 2],
    };
    let half = program(vec![half.into()]);
    assert!(matches!(
        verify(&half, &plan(&half)),
        Err(PlanFault::Unwritten { op: 1, .. })
    ));
}

proptest! {
    /// Plans random chains of ops over random buffers: the plan is proven, and no smaller than its
    /// lower bound.
    #[test]
    fn random_programs_are_planned(steps in prop::collection::vec((0usize..6, 1u32..40), 1..40)) {
        let mut buffers = vec![Span { offset: 0, len: 8 }];
        let mut ops = vec![];
        for (back, len) in steps {
            let from = buffers[buffers.len().saturating_sub(1 + back)];
            let to = Span { offset: buffers[buffers.len() - 1].offset + buffers[buffers.len() - 1].len, len };
            buffers.push(to);
            // One element, broadcast.
            let x = Operand { space: Space::Arena, offset: from.offset + from.len - 1, len: 1 };
            ops.push(Copy { x, y: to, dims: [1, 1, 1, len], x_strides: [0; 4], y_strides: [0, 0, 0, 1] }.into());
        }
        let output = buffers[buffers.len() / 2];
        let lowered = Lowered {
            ops,
            inputs: vec![("a".into(), Place::Span(buffers[0]))],
            outputs: if buffers.len() > 2 { vec![("y".into(), Place::Span(output))] } else { vec![] },
            buffers,
            tokens: 0,
            layers: vec![],
        };
        let placed = plan(&lowered);
        prop_assert_eq!(verify(&lowered, &placed), Ok(()));
        prop_assert!(placed.arena_len >= placed.lower_bound);
    }
}
