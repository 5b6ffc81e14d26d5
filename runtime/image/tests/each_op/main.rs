//! Compares what every operation declares with what it does: check, encoding, accesses and spans.

mod images;
mod samples;

use std::collections::BTreeSet;

use lads_image::codec::Field;
use lads_image::op::{
    Attention, INT_SLOTS, IntSlot, IntegerConv, MatMul, OP_WORDS, Op, Operand, Space, Span,
    WeightSpan,
};
use lads_image::{Access, AccessKind, Checker, Fault, Isa, Machine, Program, Spaces, Work};
use samples::{attention, samples, span, weight};

const ARENA: u32 = 600;
const TOKENS: u32 = 2;
const SPACES: Spaces = Spaces {
    weights_len: 400,
    cache_len: 200,
    rows: 9,
};
/// Number of rows of the cache that are valid before a run.
const PAST: usize = 3;

fn check(op: &Op) -> Result<(), Fault> {
    op.check(&Checker::new(SPACES, ARENA, TOKENS))
}

fn spans(op: &Op) -> Vec<Span> {
    let (mut op, mut spans) = (*op, vec![]);
    op.each_span(&mut |span| spans.push(*span));
    spans
}

fn accesses(op: &Op) -> Vec<Access> {
    let mut all = vec![];
    op.accesses(&mut |access| all.push(access));
    all
}

/// Returns the offsets of spans outside the arena, each with the length of its span and of its
/// space.
fn outside_the_arena(op: &mut Op) -> Vec<(&mut u32, u32, usize)> {
    fn weights(span: &mut WeightSpan) -> (&mut u32, u32, usize) {
        (&mut span.offset, span.len, SPACES.weights_len)
    }
    fn operand(operand: &mut Operand) -> Option<(&mut u32, u32, usize)> {
        let weights = operand.space == Space::Weights;
        weights.then_some((&mut operand.offset, operand.len, SPACES.weights_len))
    }
    match op {
        Op::Linear(op) => [Some(&mut op.w), op.scales.as_mut(), op.bias.as_mut()]
            .into_iter()
            .flatten()
            .map(weights)
            .collect(),
        Op::LayerNorm(op) => vec![weights(&mut op.gamma), weights(&mut op.beta)],
        Op::Attention(op) => [&mut op.cache_k, &mut op.cache_v]
            .map(|span| (&mut span.offset, span.len, SPACES.cache_len))
            .into(),
        Op::Binary(op) => [&mut op.a, &mut op.b]
            .into_iter()
            .filter_map(operand)
            .collect(),
        Op::MatMul(op) => [&mut op.a, &mut op.b]
            .into_iter()
            .filter_map(operand)
            .collect(),
        Op::Unary(op) => operand(&mut op.x).into_iter().collect(),
        Op::Reduce(op) => operand(&mut op.x).into_iter().collect(),
        Op::Copy(op) => operand(&mut op.x).into_iter().collect(),
        Op::GatherRow(op) => operand(&mut op.table).into_iter().collect(),
        Op::Conv(op) => vec![weights(&mut op.w), weights(&mut op.bias)],
        Op::Depthwise(op) => vec![weights(&mut op.w), weights(&mut op.bias)],
        Op::IntegerConv(op) => vec![weights(&mut op.w), weights(&mut op.columns)],
        Op::Border(op) => op.value.as_mut().into_iter().map(weights).collect(),
        Op::Resize(op) => vec![weights(&mut op.rows), weights(&mut op.cols)],
        Op::Softmax(_)
        | Op::ArgMin(_)
        | Op::ArgMax(_)
        | Op::ImageIntegers(_)
        | Op::Pool(_)
        | Op::ToIndex(_)
        | Op::FromIndex(_) => vec![],
    }
}

#[test]
fn every_operation_has_a_sound_sample() {
    let names: BTreeSet<&str> = samples().iter().map(Op::name).collect();
    assert_eq!(names, Op::NAMES.iter().copied().collect());
    for op in samples() {
        assert_eq!(check(&op), Ok(()), "{op:?}");
    }
}

#[test]
fn every_operation_is_read_as_it_was_written() {
    for op in samples() {
        let words = op.encode();
        assert_eq!(Op::decode(&words), Some(op));
        // Words after an op are zero. The largest ones fill all of them.
        let mut more = words;
        more[OP_WORDS - 1] = 1;
        if !matches!(op, Op::Attention(_) | Op::IntegerConv(_)) {
            assert_eq!(Op::decode(&more), None, "{op:?}");
        }
    }
    assert_eq!(
        [Attention::WORDS + 1, IntegerConv::WORDS + 1],
        [OP_WORDS; 2]
    );
}

#[test]
fn every_span_moved_outside_its_space_is_refused() {
    for op in samples() {
        for (i, span) in spans(&op).into_iter().enumerate() {
            for to in [ARENA - span.len + 1, ARENA, u32::MAX - 1, u32::MAX] {
                let (mut moved, mut at) = (op, 0);
                moved.each_span(&mut |span| {
                    if at == i {
                        span.offset = to;
                    }
                    at += 1;
                });
                assert_eq!(check(&moved), Err(Fault::Bounds), "{moved:?}");
            }
        }
        let mut moved = op;
        for i in 0..outside_the_arena(&mut moved).len() {
            for beyond in [1, u32::MAX] {
                let mut moved = op;
                let (offset, len, space) = outside_the_arena(&mut moved).swap_remove(i);
                *offset = (space as u32 - len).saturating_add(beyond);
                assert_eq!(check(&moved), Err(Fault::Bounds), "{moved:?}");
            }
        }
    }
}

#[test]
fn every_empty_or_shortened_span_is_refused() {
    for op in samples() {
        for (i, span) in spans(&op).into_iter().enumerate() {
            // A copy's result may be longer than what is copied; what is searched may have any length.
            let free = match op {
                Op::Copy(op) => span == op.y,
                Op::ArgMin(_) | Op::ArgMax(_) => true,
                _ => false,
            };
            for len in [0, span.len - 1] {
                let (mut short, mut at) = (op, 0);
                short.each_span(&mut |span| {
                    if at == i {
                        span.len = len;
                    }
                    at += 1;
                });
                if len == 0 || !free {
                    assert!(check(&short).is_err(), "{short:?}");
                }
            }
        }
    }
}

#[test]
fn accesses_lie_in_the_spans_that_are_shown() {
    for op in samples() {
        let (spans, accesses) = (spans(&op), accesses(&op));
        for access in &accesses {
            for element in access.elements() {
                let inside = spans.iter().any(|span| span.range().contains(&element));
                assert!(inside, "{op:?}: {access:?} reaches {element}");
            }
        }
        for span in &spans {
            let touched = accesses
                .iter()
                .flat_map(|access| access.elements())
                .any(|element| span.range().contains(&element));
            assert!(touched, "{op:?}: nothing touches {span:?}");
        }
        let written = accesses
            .iter()
            .position(|access| access.kind == AccessKind::Write);
        let order = accesses.split_at(written.unwrap_or(accesses.len()));
        assert!(
            order
                .1
                .iter()
                .all(|access| access.kind == AccessKind::Write)
        );
    }
}

#[test]
fn accesses_move_with_their_spans() {
    for op in samples() {
        let mut moved = op;
        moved.each_span(&mut |span| span.offset += 7);
        let expected: Vec<Access> = accesses(&op)
            .into_iter()
            .map(|access| Access {
                offset: access.offset + 7,
                ..access
            })
            .collect();
        assert_eq!(accesses(&moved), expected);
    }
}

/// Runs one op on an arena, and returns the arena and the integers.
fn run(op: &Op, mut arena: Vec<f32>) -> (Vec<f32>, [u32; INT_SLOTS]) {
    let words = [op.encode()];
    // The whole arena is a port, so that the op may use any part of it.
    let place = lads_image::place::Place::Span(span(0, ARENA));
    let program = Program::new_checked(&words, ARENA, TOKENS, SPACES, [place].into_iter())
        .expect("the sample is sound");
    let weights: Vec<f32> = (0..SPACES.weights_len)
        .map(|i| ((i * 37 % 101) as f32 - 50.0) / 64.0)
        .collect();
    let mut machine = Machine {
        arena: &mut arena,
        cache: &mut vec![0.25; SPACES.cache_len],
        ints: [1; INT_SLOTS],
        past: PAST,
        isa: Isa::detect(),
    };
    program
        .run(&weights, &mut machine)
        .expect("the sample runs");
    let ints = machine.ints;
    (arena, ints)
}

/// Compares the declared accesses with a run, which reads and writes nothing else, and writes all
/// of the elements declared as written.
#[test]
fn accesses_are_what_a_run_does() {
    for op in samples() {
        let elements = |kind: AccessKind| -> BTreeSet<usize> {
            let of = accesses(&op).into_iter().filter(move |a| a.kind == kind);
            of.flat_map(Access::elements).collect()
        };
        let (read, written) = (elements(AccessKind::Read), elements(AccessKind::Write));
        let arena = |unread: f32| -> Vec<f32> {
            let value = |i: usize| ((i * 29 % 97) as f32 - 48.0) / 32.0;
            (0..ARENA as usize)
                .map(|i| if read.contains(&i) { value(i) } else { unread })
                .collect()
        };
        let scratch = match op {
            Op::Attention(op) => op.scratch.range(),
            _ => 0..0,
        };
        let (quiet, loud) = (arena(1e6), arena(f32::NAN));
        let (first, ints) = run(&op, quiet.clone());
        let (second, same_ints) = run(&op, loud.clone());
        assert_eq!(ints, same_ints, "{op:?}");
        for i in 0..ARENA as usize {
            if scratch.contains(&i) {
                continue;
            }
            if written.contains(&i) {
                // Pairs of integers may look like anything.
                let is_float = !matches!(op, Op::ImageIntegers(_));
                assert!(!is_float || first[i].is_finite(), "{op:?} at {i}");
                assert!(first[i] != 1e6, "{op:?} at {i}");
                assert_eq!(first[i].to_bits(), second[i].to_bits(), "{op:?} at {i}");
            } else {
                assert_eq!(first[i].to_bits(), quiet[i].to_bits(), "{op:?} at {i}");
                assert_eq!(second[i].to_bits(), loud[i].to_bits(), "{op:?} at {i}");
            }
        }
        let slots = op.slots();
        for (slot, &int) in ints.iter().enumerate() {
            let may = slots.written == Some(IntSlot(slot as u8));
            assert!(int == 1 || may, "{op:?} writes slot {slot}");
        }
        let index = matches!(op, Op::ArgMin(_) | Op::ArgMax(_) | Op::ToIndex(_));
        assert_eq!(slots.written.is_some(), index);
        let reads = matches!(op, Op::GatherRow(_) | Op::FromIndex(_));
        assert_eq!(slots.read.is_some(), reads);
    }
}

#[test]
fn work_counts_what_is_multiplied_and_read() {
    let work = |op: Op| op.work();
    let of = |multiply_adds, weight_words, state_words| Work {
        multiply_adds,
        weight_words,
        state_words,
    };
    // Two queries over nine rows of six elements, once for scores and once for values; keys lie in whole blocks.
    assert_eq!(work(attention(2).into()), of(2 * 2 * 54, 0, 96 + 54));
    // Two tokens are recorded.
    assert_eq!(work(attention(0).into()), of(0, 0, 24));
    for op in samples() {
        let work = op.work();
        match op {
            Op::Linear(op) => {
                let columns = op.scales.map_or(0, |span| span.len) + 20;
                assert_eq!(work, of(200, u64::from(op.w.len + columns), 0));
            }
            Op::GatherRow(op) => {
                let weights = op.table.space == Space::Weights;
                assert_eq!(work, of(3, if weights { 3 } else { 0 }, 0));
            }
            Op::Copy(op) => {
                let weights = op.x.space == Space::Weights;
                assert_eq!(work, of(12, if weights { 12 } else { 0 }, 0));
            }
            Op::MatMul(_) => assert_eq!(work.multiply_adds, 24),
            Op::Conv(op) => assert_eq!(work, of(108, u64::from(op.w.len + 3), 0)),
            Op::Depthwise(op) => assert_eq!(work, of(36, u64::from(op.w.len + 3), 0)),
            Op::ImageIntegers(_) => assert_eq!(work, of(60, 0, 0)),
            Op::IntegerConv(op) => assert_eq!(work, of(108, u64::from(op.w.len + 6), 0)),
            Op::Border(op) => {
                let inside = u64::from(op.inside.rows) * u64::from(op.inside.cols);
                let filled = u64::from(op.y.len) - inside * u64::from(op.c);
                let weights = op.value.map_or(0, |value| value.len.into());
                assert_eq!(work, of(filled, weights, 0));
            }
            Op::LayerNorm(_) => assert_eq!(work, of(10, 10, 0)),
            Op::Attention(_) => assert!(work.state_words > 0 && work.weight_words == 0),
            _ => assert!(work.multiply_adds > 0, "{op:?}"),
        }
    }
    // Whatever an image says, nothing overflows.
    let most = MatMul {
        a: span(0, u32::MAX).into(),
        b: weight(0, u32::MAX).into(),
        y: span(0, u32::MAX),
        batch: u32::MAX,
        m: u32::MAX,
        k: u32::MAX,
        n: u32::MAX,
        a_strides: [u32::MAX; 3],
        b_strides: [u32::MAX; 3],
    };
    let most = work(most.into());
    assert_eq!(most.multiply_adds, u64::MAX);
    assert_eq!(most.and(most).multiply_adds, u64::MAX);
}
