//! What every operation says of itself, held against what it does: check, encoding, accesses and spans.

use std::collections::BTreeSet;

use lads_image::codec::Field;
use lads_image::op::{
    Activation, ArgMax, ArgMin, Attention, Binary, BinaryKind, CacheFormat, Copy, FromIndex,
    GatherRow, INT_SLOTS, IntSlot, LayerNorm, Linear, MatMul, OP_WORDS, Op, Operand, Reduce,
    ReduceKind, Softmax, Space, Span, StateSpan, ToIndex, Unary, UnaryKind, WeightFormat,
    WeightSpan,
};
use lads_image::{Access, AccessKind, Checker, Fault, Isa, Machine, Program, Spaces, Work};
use lads_kernels::{attention_scratch_len, packed_len};

const ARENA: u32 = 600;
const TOKENS: u32 = 2;
const SPACES: Spaces = Spaces {
    weights_len: 400,
    cache_len: 200,
    rows: 9,
};
/// Rows of the cache that are there before a run.
const PAST: usize = 3;

const fn span(offset: u32, len: u32) -> Span {
    Span { offset, len }
}

const fn weight(offset: u32, len: u32) -> WeightSpan {
    WeightSpan { offset, len }
}

fn attention(queries: u32) -> Attention {
    let (heads, head_dim) = (2, 3);
    let width = heads * head_dim;
    let row = |queries| if queries == 0 { 0 } else { width };
    let scratch = attention_scratch_len(queries as usize, heads as usize, SPACES.rows) as u32;
    let strided = if queries == 0 { 0 } else { (queries - 1) * 20 };
    Attention {
        q: span(300, strided + row(queries)),
        q_stride: 20,
        k: span(6, 20 + width),
        k_stride: 20,
        v: span(12, 20 + width),
        v_stride: 20,
        y: span(400, queries * width),
        format: CacheFormat::F32,
        cache_k: StateSpan {
            offset: 4,
            len: 16 * width,
        },
        cache_v: StateSpan {
            offset: 110,
            len: 9 * width,
        },
        heads,
        head_dim,
        tokens: TOKENS,
        queries,
        scale: 0.5,
        scratch: span(450, scratch),
    }
}

/// Sound ops: every kind, with its operands in each of the places where they may lie.
#[expect(clippy::too_many_lines, reason = "one sample per op and place")]
fn samples() -> Vec<Op> {
    let linear = |format: WeightFormat, accumulate| {
        let words = packed_len(format, [5, 20]) * format.bytes() / 4;
        Linear {
            x: span(10, 10),
            format,
            w: weight(0, words as u32),
            scales: format.is_scaled().then_some(weight(300, 20)),
            bias: Some(weight(350, 20)),
            y: span(100, 40),
            m: 2,
            k: 5,
            n: 20,
            activation: Activation::Tanh,
            accumulate,
        }
    };
    let mut ops: Vec<Op> = vec![];
    for format in WeightFormat::ALL {
        ops.push(linear(format, false).into());
        ops.push(linear(format, true).into());
    }
    let norm = LayerNorm {
        x: span(10, 10),
        y: span(30, 10),
        gamma: weight(3, 5),
        beta: weight(9, 5),
        rows: 2,
        cols: 5,
        eps: 1e-5,
    };
    ops.push(norm.into());
    ops.extend([0, 1, 2].map(|queries| Op::from(attention(queries))));
    let half = attention(2);
    let half = Attention {
        format: CacheFormat::F16,
        cache_k: StateSpan {
            len: half.cache_k.len / 2,
            ..half.cache_k
        },
        cache_v: StateSpan {
            len: half.cache_v.len / 2,
            ..half.cache_v
        },
        ..half
    };
    ops.push(half.into());
    let (arena, weights): (Operand, Operand) = (span(10, 12).into(), weight(20, 12).into());
    for x in [arena, weights] {
        let unary = Unary {
            kind: UnaryKind::Square,
            alpha: 0.0,
            x,
            y: span(30, 12),
        };
        ops.push(unary.into());
        let reduce = Reduce {
            kind: ReduceKind::Mean,
            x,
            y: span(30, 4),
            outer: 2,
            axis: 3,
            inner: 2,
        };
        ops.push(reduce.into());
        let copy = Copy {
            x,
            y: span(30, 16),
            dims: [1, 2, 2, 3],
            x_strides: [0, 6, 1, 2],
            y_strides: [0, 8, 4, 1],
        };
        ops.push(copy.into());
        let gather = GatherRow {
            table: x,
            row_len: 3,
            rows: 4,
            index: IntSlot(2),
            shift: 1,
            y: span(30, 3),
        };
        ops.push(gather.into());
        let binary = Binary {
            kind: BinaryKind::Sub,
            a: x,
            b: span(50, 3).into(),
            y: span(30, 12),
            dims: [1, 1, 4, 3],
            a_strides: [0, 0, 3, 1],
            b_strides: [0, 0, 0, 1],
        };
        ops.push(binary.into());
        let product = MatMul {
            a: x,
            b: span(50, 12).into(),
            y: span(30, 8),
            batch: 2,
            m: 2,
            k: 3,
            n: 2,
            a_strides: [6, 3, 1],
            b_strides: [6, 1, 3],
        };
        ops.push(product.into());
    }
    let in_place = Unary {
        kind: UnaryKind::Neg,
        alpha: 0.0,
        x: arena,
        y: span(10, 12),
    };
    ops.push(in_place.into());
    let in_place = Binary {
        kind: BinaryKind::Mul,
        a: arena,
        b: weight(20, 1).into(),
        y: span(10, 12),
        dims: [1, 1, 1, 12],
        a_strides: [0, 0, 0, 1],
        b_strides: [0; 4],
    };
    ops.push(in_place.into());
    let softmax = Softmax {
        x: span(10, 12),
        y: span(30, 12),
        rows: 3,
        cols: 4,
    };
    ops.push(softmax.into());
    let (x, out) = (span(10, 12), IntSlot(7));
    ops.push(ArgMin { x, out }.into());
    ops.push(ArgMax { x, out }.into());
    let (one, index) = (span(10, 1), IntSlot(7));
    ops.push(ToIndex { x: one, out }.into());
    ops.push(
        FromIndex {
            index,
            shift: -3,
            y: one,
        }
        .into(),
    );
    ops
}

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

/// The offsets of spans outside the arena, each with the length of its span and of its space.
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
        Op::Softmax(_) | Op::ArgMin(_) | Op::ArgMax(_) | Op::ToIndex(_) | Op::FromIndex(_) => {
            vec![]
        }
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
        // Words behind an op are zero. Attention fills all of them.
        let mut more = words;
        more[OP_WORDS - 1] = 1;
        if !matches!(op, Op::Attention(_)) {
            assert_eq!(Op::decode(&more), None, "{op:?}");
        }
    }
    assert_eq!(Attention::WORDS + 1, OP_WORDS);
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

/// Runs one op over an arena whose elements are `values`, and returns the arena.
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

/// A run reads nothing and writes nothing but what the accesses say, and writes all of that.
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
                assert!(first[i].is_finite() && first[i] != 1e6, "{op:?} at {i}");
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
                assert_eq!(work, of(0, if weights { 3 } else { 0 }, 0));
            }
            Op::Copy(op) => {
                let weights = op.x.space == Space::Weights;
                assert_eq!(work, of(0, if weights { 12 } else { 0 }, 0));
            }
            Op::MatMul(_) => assert_eq!(work.multiply_adds, 24),
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
