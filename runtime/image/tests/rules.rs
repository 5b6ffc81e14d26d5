//! Tests of each rule of each op, broken once in a program that is sound otherwise.

mod support;

use lads_image::Fault;
use lads_image::op::{Activation, BinaryKind, CacheFormat, Op, Span};
use support::{Kind, sound};

/// Returns the fault that checking reports after `edit` has changed a program.
fn fault(kind: Kind, edit: impl FnOnce(&mut Vec<Op>)) -> Option<Fault> {
    let mut policy = sound();
    edit(&mut policy.draft_mut(kind).ops);
    let words = policy.encode(kind);
    policy.check(kind, &words).err().map(|error| error.fault)
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
    use Kind::{Act, Instruct, Lookup, Start, StepDecide};
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
    let smaller = |format: CacheFormat, [keys, values]: [u32; 2]| {
        fault(StepDecide, |ops| {
            edit_first!(ops, Attention, op => {
                let heads = [op.heads, op.head_dim].map(|count| count as usize);
                let capacity = op.cache_v.len as usize / (heads[0] * heads[1]);
                op.format = format;
                [op.cache_k.len, op.cache_v.len] = format.words(capacity, heads).unwrap().map(|words| words as u32);
                op.cache_k.len -= keys;
                op.cache_v.len -= values;
            });
        })
    };
    for format in [CacheFormat::F16, CacheFormat::Int8] {
        assert_eq!(smaller(format, [0, 0]), None);
        assert_eq!(smaller(format, [1, 0]), shape);
        assert_eq!(smaller(format, [0, 1]), Some(Fault::Capacity));
    }
}

#[test]
#[expect(clippy::too_many_lines, reason = "one line per rule")]
fn each_rule_of_the_ops_that_the_tiny_policy_does_without() {
    use lads_image::op::{
        Copy, GatherRow, IntSlot, MatMul, Operand, Reduce, ReduceKind, Softmax, Space, Unary,
        UnaryKind,
    };
    // Two spans of the arena of `act` that are there anyway, apart from each other.
    let (x, y) = (Span { offset: 0, len: 4 }, Span { offset: 4, len: 2 });
    let with = |op: Op| fault(Kind::Act, move |ops| ops.insert(0, op));
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
    let gather = GatherRow {
        table: x.into(),
        row_len: 2,
        rows: 2,
        index: IntSlot(0),
        shift: 0,
        y,
    };
    assert_eq!(with(gather.into()), None);
    let onto = Span { offset: 3, len: 2 };
    assert_eq!(
        with(GatherRow { y: onto, ..gather }.into()),
        Some(Fault::Overlap)
    );
    assert_eq!(
        with(GatherRow { rows: 3, ..gather }.into()),
        Some(Fault::Shape)
    );
    let linear =
        |ops: &mut Vec<Op>| edit_first!(ops, Linear, op => op.activation = Activation::Tanh);
    assert_eq!(fault(Kind::Act, linear), None);
    let add = |ops: &mut Vec<Op>| edit_first!(ops, Binary, op => op.kind = BinaryKind::Max);
    assert_eq!(fault(Kind::Start, add), None);
}

#[test]
fn an_attention_knows_as_many_rows_as_the_state() {
    let with = |rows: u32| {
        let mut policy = sound();
        policy.rows = rows;
        let words = policy.encode(Kind::StepDecide);
        policy
            .check(Kind::StepDecide, &words)
            .err()
            .map(|error| error.fault)
    };
    let rows = sound().rows;
    assert_eq!(with(rows), None);
    for other in [0, 1, rows - 1, rows + 1, u32::MAX] {
        assert_eq!(with(other), Some(Fault::Capacity), "{other} rows");
    }
}
