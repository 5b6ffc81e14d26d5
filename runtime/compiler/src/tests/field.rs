//! Tests of features that policy files of the field use besides plain layers: old operator sets,
//! vectors without a batch axis, conditions, Einstein sums, sequences, numbers that are indices.
//! They are compared with tract, or where it has no such operator, with the definition.

use proptest::prelude::*;

use super::machine::Machine;
use super::models::{Small, float, int, ints, text};
use super::operators::{agrees, agrees_at, compile, names, refused};
use crate::graph::{Dim, Type};

/// Runs a program on one input `a`.
fn run(small: &Small, a: &[f32]) -> Vec<f32> {
    let program = compile(small).unwrap_or_else(|error| panic!("{error}"));
    let mut machine = Machine::new(&program.placed, &program.weights, vec![]);
    machine.set(&program.placed, "a", a);
    machine.run(&program.placed, 0);
    machine.output(&program.placed, "y")
}

#[test]
fn layers_take_in_the_activations_of_the_field() {
    for operator in ["Elu", "Softplus"] {
        let small = Small::new()
            .input("a", &[1, 6])
            .random("w", &[8, 6])
            .random("bias", &[8])
            .node("Gemm", &["a", "w", "bias"], &["p"], &[int("transB", 1)])
            .node(operator, &["p"], &["y"], &[])
            .output("y", &[1, 8]);
        assert_eq!(names(&agrees_at(11, small)), ["Linear"], "{operator}");
    }
}

#[test]
fn vectors_without_a_batch_axis_are_layers_too() {
    let small = Small::new()
        .input("a", &[6])
        .random("w", &[6, 8])
        .random("bias", &[8])
        .random("v", &[8, 3])
        .random("more", &[3])
        .node("MatMul", &["a", "w"], &["p"], &[])
        .node("Add", &["p", "bias"], &["q"], &[])
        .node("Elu", &["q"], &["r"], &[float("alpha", 0.7)])
        .node("MatMul", &["r", "v"], &["s"], &[])
        .node("Add", &["more", "s"], &["y"], &[])
        .output("y", &[3]);
    assert_eq!(names(&agrees_at(11, small)), ["Linear", "Linear"]);
    let column = Small::new()
        .input("a", &[6])
        .random("w", &[2, 5, 6])
        .node("MatMul", &["w", "a"], &["y"], &[])
        .output("y", &[2, 5]);
    agrees(column);
    let row = Small::new()
        .input("a", &[6])
        .input("b", &[2, 6, 5])
        .node("MatMul", &["a", "b"], &["y"], &[])
        .output("y", &[2, 5]);
    agrees(row);
    // tract has no product of two vectors to compare with.
    let product = Small::new()
        .input("a", &[3])
        .weights("b", &[3], &[2.0, -3.0, 0.5])
        .node("MatMul", &["a", "b"], &["y"], &[])
        .output("y", &[]);
    assert_eq!(run(&product, &[1.0, 2.0, 4.0]), [-2.0]);
}

#[test]
fn old_operator_sets_mean_what_they_meant() {
    for axis in [0, 1, 2] {
        for operator in ["Softmax", "LogSoftmax"] {
            let small = Small::new()
                .input("a", &[2, 3, 4])
                .node(operator, &["a"], &["y"], &[int("axis", axis)])
                .output("y", &[2, 3, 4]);
            agrees_at(11, small);
        }
    }
    let clipped = Small::new()
        .input("a", &[8])
        .node(
            "Clip",
            &["a"],
            &["y"],
            &[float("min", -0.2), float("max", 0.4)],
        )
        .output("y", &[8]);
    agrees_at(9, clipped);
    let sliced = Small::new().input("a", &[3, 7]).node(
        "Slice",
        &["a"],
        &["y"],
        &[ints("starts", &[1, -4]), ints("ends", &[3, 100])],
    );
    agrees_at(9, sliced.output("y", &[2, 4]));
    let axes = Small::new()
        .input("a", &[3, 1, 7])
        .node("Squeeze", &["a"], &["s"], &[ints("axes", &[1])])
        .node("Unsqueeze", &["s"], &["u"], &[ints("axes", &[0])])
        .node(
            "ReduceSum",
            &["u"],
            &["y"],
            &[ints("axes", &[2]), int("keepdims", 0)],
        );
    agrees_at(9, axes.output("y", &[1, 3]));
    let padded = Small::new().input("a", &[2, 3]).node(
        "Pad",
        &["a"],
        &["y"],
        &[ints("pads", &[0, 1, 1, 2]), float("value", 0.5)],
    );
    agrees_at(9, padded.output("y", &[3, 6]));
}

#[test]
fn conditions_select_exactly() {
    // Also when the other side overflows: it is not part of the result.
    let small = Small::new()
        .input("a", &[5])
        .weights("limit", &[1], &[0.5])
        .node("Exp", &["a"], &["e"], &[])
        .node("Greater", &["a", "limit"], &["c"], &[])
        .node("Where", &["c", "a", "e"], &["y"], &[])
        .output("y", &[5]);
    let a = [-2.0, 0.5, 0.75, 3.0, 1000.0];
    let expected = a.map(|a: f32| if a > 0.5 { a } else { a.exp() });
    assert_eq!(run(&small, &a), expected);
    let both = Small::new()
        .input("a", &[4])
        .weights("low", &[], &[-1.0])
        .weights("high", &[], &[1.0])
        .weights("zero", &[], &[0.0])
        .node("GreaterOrEqual", &["a", "low"], &["above"], &[])
        .node("LessOrEqual", &["a", "high"], &["below"], &[])
        .node("And", &["above", "below"], &["inside"], &[])
        .node("Not", &["inside"], &["outside"], &[])
        .node("Where", &["outside", "zero", "a"], &["y"], &[])
        .output("y", &[4]);
    assert_eq!(
        run(&both, &[-1.5, -1.0, 0.25, 1.25]),
        [0.0, -1.0, 0.25, 0.0]
    );
}

#[test]
fn a_number_is_an_index_of_a_table() {
    let small = Small::new()
        .input("a", &[1, 1])
        .integers("last", &[4])
        .weights("table", &[5, 2], &[0., 1., 2., 3., 4., 5., 6., 7., 8., 9.])
        .node("Cast", &["a"], &["i"], &[int("to", 7)])
        .node("Min", &["i", "last"], &["j"], &[])
        .node("Gather", &["table", "j"], &["g"], &[])
        .integers("row", &[1, 2])
        .node("Reshape", &["g", "row"], &["y"], &[])
        .output("y", &[1, 2]);
    for (a, expected) in [(0.0, [0., 1.]), (2.9, [4., 5.]), (77.0, [8., 9.])] {
        assert_eq!(run(&small, &[a]), expected);
    }
    // And an index is a number.
    let back = Small::new()
        .input_dims("i", Type::I64, &[Dim::of(1)])
        .input("a", &[1])
        .node("Cast", &["i"], &["n"], &[int("to", 1)])
        .node("Mul", &["n", "a"], &["y"], &[])
        .output("y", &[1]);
    assert_eq!(names(&agrees(back)), ["FromIndex", "Binary"]);
}

#[test]
fn sequences_leave_nothing_behind() {
    let small = Small::new()
        .input("a", &[1, 6])
        .integers("lens", &[2, 4])
        .integers("second", &[1])
        .node("SplitToSequence", &["a", "lens"], &["s"], &[int("axis", 1)])
        .node("SequenceAt", &["s", "second"], &["p"], &[])
        .node("Neg", &["p"], &["y"], &[])
        .output("y", &[1, 4]);
    assert_eq!(run(&small, &[1., 2., 3., 4., 5., 6.]), [-3., -4., -5., -6.]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    /// Compares Einstein sums of two operands over random lengths of named axes with the sum by its
    /// definition.
    #[test]
    fn einstein_sums_are_what_they_say(
        lens in prop::collection::vec(1_usize..4, 4),
        left in prop::sample::subsequence(vec![0_usize, 1, 2, 3], 1..=3).prop_shuffle(),
        right in prop::sample::subsequence(vec![0_usize, 1, 2, 3], 1..=3).prop_shuffle(),
        kept in any::<[bool; 4]>(),
    ) {
        let shape = |axes: &[usize]| -> Vec<usize> { axes.iter().map(|&axis| lens[axis]).collect() };
        let out: Vec<usize> = (0..4)
            .filter(|axis| kept[*axis] && (left.contains(axis) || right.contains(axis)))
            .collect();
        prop_assume!(!out.is_empty());
        let letters = |axes: &[usize]| -> String { axes.iter().map(|&axis| char::from(b'i' + axis as u8)).collect() };
        let equation = format!("{},{}->{}", letters(&left), letters(&right), letters(&out));
        let mut small = Small::new().input("a", &shape(&left));
        let count = |axes: &[usize]| shape(axes).iter().product::<usize>();
        let (x, w) = (small.numbers(count(&left)), small.numbers(count(&right)));
        let small = small
            .weights("w", &shape(&right), &w)
            .node("Einsum", &["a", "w"], &["y"], &[text("equation", &equation)])
            .output("y", &shape(&out));
        let offset = |axes: &[usize], at: &[usize; 4]| axes.iter().fold(0, |sum, &axis| sum * lens[axis] + at[axis]);
        let mut expected = vec![0.0_f64; count(&out)];
        for i in 0..lens.iter().product() {
            let mut rest: usize = i;
            let at: [usize; 4] = std::array::from_fn(|axis| {
                let at = rest % lens[axis];
                rest /= lens[axis];
                at
            });
            // An axis without a name is not an axis.
            let named = |axis: usize| left.contains(&axis) || right.contains(&axis);
            if (0..4).any(|axis| !named(axis) && at[axis] > 0) {
                continue;
            }
            expected[offset(&out, &at)] += f64::from(x[offset(&left, &at)]) * f64::from(w[offset(&right, &at)]);
        }
        for (got, expected) in run(&small, &x).iter().zip(&expected) {
            prop_assert!((f64::from(*got) - expected).abs() < 1e-5, "{equation}: {got} against {expected}");
        }
    }
}

#[test]
fn what_loses_bits_or_has_no_bound_is_refused() {
    let narrow = Small::new()
        .integers("many", &[300])
        .input("a", &[1])
        .node("Cast", &["many"], &["c"], &[int("to", 2)])
        .node("Add", &["a", "c"], &["y"], &[])
        .output("y", &[1]);
    refused(&narrow, &["Cast", "uint8", "300"]);
    let endless = Small::new()
        .integers("times", &[5000])
        .input("a", &[1])
        .node("Tile", &["a", "times"], &["y"], &[])
        .output("y", &[5000]);
    refused(&endless, &["Tile", "5000", "1024"]);
    let twice = Small::new()
        .input("a", &[2, 2])
        .node("Einsum", &["a"], &["y"], &[text("equation", "ii->i")])
        .output("y", &[2]);
    refused(&twice, &["Einsum", "ii"]);
}

#[test]
fn picked_columns_go_into_the_matrix() {
    let small = Small::new()
        .input("a", &[1, 4])
        .input("b", &[1, 3])
        .integers("left", &[3, 1])
        .integers("right", &[2, 0])
        .random("w", &[7, 5])
        .node("Gather", &["a", "left"], &["p"], &[int("axis", 1)])
        .node("Gather", &["a", "right"], &["q"], &[int("axis", 1)])
        .node("Concat", &["p", "b", "q"], &["x"], &[int("axis", 1)])
        .node("MatMul", &["x", "w"], &["y"], &[])
        .output("y", &[1, 5]);
    let made = names(&agrees(small));
    // Both inputs as they lie, then the layer.
    assert!(
        made.last().map(AsRef::as_ref) == Some("Linear") && made.len() <= 3,
        "{made:?}"
    );
}
