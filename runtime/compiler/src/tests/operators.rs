//! Tests of each ONNX operator on its own against tract, and of refusals.

use std::collections::HashMap;

use super::machine::Machine;
use super::models::{Small, float, int, ints, text};
use super::oracle::{Oracle, close, integer, tensor};
use super::{Compiled, compiled, doubles};
use crate::error::CompileError;
use crate::graph::{Dim, Type};
use crate::lower::Cache;

pub(super) fn compile(small: &Small) -> Result<Compiled, CompileError> {
    let outputs: Vec<&str> = small
        .signature
        .outputs
        .iter()
        .map(|output| output.name.as_str())
        .collect();
    compiled(&small.model(18), &small.signature, &outputs, Cache::NONE)
}

/// Compiles, runs and compares, and evaluates the graph in double precision.
#[track_caller]
pub(super) fn agrees(small: Small) -> Compiled {
    agrees_at(18, small)
}

/// Compiles with another operator set, runs and compares, and evaluates the graph in double
/// precision.
#[track_caller]
pub(super) fn agrees_at(opset: i64, mut small: Small) -> Compiled {
    let outputs: Vec<String> = (small.signature.outputs.iter())
        .map(|output| output.name.clone())
        .collect();
    let outputs: Vec<&str> = outputs.iter().map(String::as_str).collect();
    let program = compiled(&small.model(opset), &small.signature, &outputs, Cache::NONE)
        .unwrap_or_else(|error| panic!("{error}"));
    let oracle = Oracle::new(&small.bytes(opset));
    let mut machine = Machine::new(&program.placed, &program.weights, vec![]);
    let (mut inputs, mut given) = (HashMap::new(), HashMap::new());
    for input in small.signature.inputs.clone() {
        let shape: Vec<usize> = input.shape.iter().map(|dim| dim.fixed).collect();
        if input.ty == Type::I64 {
            machine.set(&program.placed, &input.name, &[2.0]);
            inputs.insert(input.name.clone(), integer(2));
            given.insert(input.name, vec![2.0]);
        } else {
            let values = small.numbers(shape.iter().product());
            machine.set(&program.placed, &input.name, &values);
            inputs.insert(input.name.clone(), tensor(&shape, &values));
            given.insert(input.name, values);
        }
    }
    machine.run(&program.placed, 0);
    let evaluated = doubles::outputs(&small.model(opset), &small.signature, &given);
    for (name, wanted) in oracle.run(&inputs) {
        close(&name, &machine.output(&program.placed, &name), &wanted);
        close(&name, &evaluated[&name], &wanted);
    }
    program
}

pub(super) fn names(program: &Compiled) -> Vec<&'static str> {
    program
        .placed
        .ops
        .iter()
        .map(lads_image::op::Op::name)
        .collect()
}

#[track_caller]
pub(super) fn refused(small: &Small, parts: &[&str]) {
    let Err(error) = compile(small) else {
        panic!("compiled")
    };
    let message = error.to_string();
    for part in parts {
        assert!(
            message.contains(part),
            "\"{message}\" does not say \"{part}\""
        );
    }
    assert!(!message.contains('\n'), "{message}");
}

#[test]
fn unary_operators() {
    for operator in [
        "Relu",
        "Tanh",
        "Sigmoid",
        "Exp",
        "Neg",
        "Abs",
        "Erf",
        "LeakyRelu",
        "Reciprocal",
    ] {
        agrees(
            Small::new()
                .input("a", &[3, 5])
                .node(operator, &["a"], &["y"], &[])
                .output("y", &[3, 5]),
        );
    }
    // Of positive numbers.
    for operator in ["Sqrt", "Log"] {
        let small = Small::new()
            .input("a", &[3, 5])
            .node("Exp", &["a"], &["e"], &[]);
        agrees(
            small
                .node(operator, &["e"], &["y"], &[])
                .output("y", &[3, 5]),
        );
    }
    agrees(
        Small::new()
            .input("a", &[7])
            .node("LeakyRelu", &["a"], &["y"], &[float("alpha", 0.2)])
            .output("y", &[7]),
    );
    let gelu = |kind| {
        Small::new()
            .input("a", &[9])
            .node("Gelu", &["a"], &["y"], &[text("approximate", kind)])
            .output("y", &[9])
    };
    for kind in ["none", "tanh"] {
        let small = gelu(kind);
        let program = compiled(&small.model(20), &small.signature, &["y"], Cache::NONE)
            .unwrap_or_else(|error| panic!("{error}"));
        let mut machine = Machine::new(&program.placed, &program.weights, vec![]);
        let values = Small::new().numbers(9);
        machine.set(&program.placed, "a", &values);
        machine.run(&program.placed, 0);
        let inputs = HashMap::from([("a".to_string(), tensor(&[9], &values))]);
        let wanted = Oracle::new(&small.bytes(20)).run(&inputs);
        // tract's own error function is good to 1e-4 only near zero; the exact one is checked in the kernels.
        for (got, wanted) in machine
            .output(&program.placed, "y")
            .iter()
            .zip(&wanted["y"])
        {
            assert!((got - wanted).abs() < 1e-4, "{kind}: {got} {wanted}");
        }
    }
}

#[test]
fn binary_operators_broadcast() {
    for operator in ["Add", "Sub", "Mul", "Div", "Max", "Min"] {
        agrees(
            Small::new()
                .input("a", &[2, 3, 4])
                .input("b", &[3, 1])
                .node(operator, &["a", "b"], &["y"], &[])
                .output("y", &[2, 3, 4]),
        );
        agrees(
            Small::new()
                .input("a", &[4])
                .random("b", &[2, 1, 4])
                .node(operator, &["a", "b"], &["y"], &[])
                .output("y", &[2, 1, 4]),
        );
        agrees(
            Small::new()
                .input("a", &[5])
                .node(operator, &["a", "a"], &["y"], &[])
                .output("y", &[5]),
        );
    }
    let power = |exponent: f32| {
        let small = Small::new()
            .input("a", &[3, 4])
            .weights("p", &[], &[exponent])
            .node("Exp", &["a"], &["e"], &[]);
        small
            .node("Pow", &["e", "p"], &["y"], &[])
            .output("y", &[3, 4])
    };
    for exponent in [2.0, 0.5, -0.5, -1.0, 1.7] {
        agrees(power(exponent));
    }
    let three = Small::new()
        .input("a", &[4])
        .input("b", &[4])
        .input("c", &[1]);
    agrees(
        three
            .node("Sum", &["a", "b", "c"], &["y"], &[])
            .output("y", &[4]),
    );
    let clip = Small::new()
        .input("a", &[8])
        .weights("low", &[], &[-0.25])
        .weights("high", &[], &[0.5]);
    agrees(
        clip.node("Clip", &["a", "low", "high"], &["y"], &[])
            .output("y", &[8]),
    );
}

#[test]
fn reductions_and_softmax() {
    for operator in [
        "ReduceSum",
        "ReduceMean",
        "ReduceMax",
        "ReduceMin",
        "ReduceProd",
        "ReduceSumSquare",
        "ReduceL1",
        "ReduceL2",
    ] {
        let with_axes = |axes: &[i64], keep: i64| {
            let small = Small::new().input("a", &[2, 3, 4]).integers("axes", axes);
            small.node(operator, &["a", "axes"], &["y"], &[int("keepdims", keep)])
        };
        agrees(with_axes(&[1], 1).output("y", &[2, 1, 4]));
        agrees(with_axes(&[-1], 0).output("y", &[2, 3]));
        agrees(with_axes(&[0, 2], 0).output("y", &[3]));
    }
    for axis in [0, 1, -1] {
        for operator in ["Softmax", "LogSoftmax"] {
            agrees(
                Small::new()
                    .input("a", &[2, 3, 4])
                    .node(operator, &["a"], &["y"], &[int("axis", axis)])
                    .output("y", &[2, 3, 4]),
            );
        }
    }
    for operator in ["ArgMin", "ArgMax"] {
        let small = Small::new().input("a", &[1, 9]).node(
            operator,
            &["a"],
            &["j"],
            &[int("axis", 1), int("keepdims", 0)],
        );
        agrees(small.output_dims("j", Type::I64, &[Dim::of(1)]));
    }
}

#[test]
fn products() {
    agrees(
        Small::new()
            .input("a", &[2, 3])
            .input("b", &[3, 4])
            .node("MatMul", &["a", "b"], &["y"], &[])
            .output("y", &[2, 4]),
    );
    agrees(
        Small::new()
            .input("a", &[5, 2, 3])
            .input("b", &[3, 4])
            .node("MatMul", &["a", "b"], &["y"], &[])
            .output("y", &[5, 2, 4]),
    );
    let heads = Small::new().input("a", &[2, 5, 3]).input("b", &[4, 5, 3]);
    let heads = heads
        .node("Transpose", &["a"], &["q"], &[ints("perm", &[1, 0, 2])])
        .node("Transpose", &["b"], &["k"], &[ints("perm", &[1, 2, 0])]);
    agrees(
        heads
            .node("MatMul", &["q", "k"], &["y"], &[])
            .output("y", &[5, 2, 4]),
    );
    let linear = Small::new()
        .input("a", &[2, 3])
        .random("w", &[3, 20])
        .node("MatMul", &["a", "w"], &["y"], &[])
        .output("y", &[2, 20]);
    assert_eq!(names(&agrees(linear)), ["Linear"]);
    let left = Small::new()
        .random("w", &[4, 3])
        .input("a", &[3, 2])
        .node("MatMul", &["w", "a"], &["y"], &[])
        .output("y", &[4, 2]);
    assert_eq!(names(&agrees(left)), ["MatMul"]);
    let gemm = |attributes: &[crate::onnx::AttributeProto]| {
        let small = Small::new()
            .input("a", &[3, 2])
            .random("w", &[5, 3])
            .random("bias", &[5]);
        small
            .node("Gemm", &["a", "w", "bias"], &["y"], attributes)
            .output("y", &[2, 5])
    };
    agrees(gemm(&[
        int("transA", 1),
        int("transB", 1),
        float("alpha", 0.5),
        float("beta", -2.0),
    ]));
}

#[test]
fn moving_elements() {
    let small = || Small::new().input("a", &[2, 3, 4]);
    agrees(
        small()
            .node("Transpose", &["a"], &["t"], &[ints("perm", &[2, 0, 1])])
            .node("Neg", &["t"], &["y"], &[])
            .output("y", &[4, 2, 3]),
    );
    agrees(
        small()
            .node("Transpose", &["a"], &["y"], &[])
            .output("y", &[4, 3, 2]),
    );
    let reshaped = small()
        .node("Transpose", &["a"], &["t"], &[ints("perm", &[1, 0, 2])])
        .integers("s", &[-1, 4]);
    agrees(
        reshaped
            .node("Reshape", &["t", "s"], &["y"], &[])
            .output("y", &[6, 4]),
    );
    agrees(
        small()
            .integers("s", &[0, -1])
            .node("Reshape", &["a", "s"], &["y"], &[])
            .output("y", &[2, 12]),
    );
    agrees(
        small()
            .node("Flatten", &["a"], &["y"], &[int("axis", 2)])
            .output("y", &[6, 4]),
    );
    let sliced = small()
        .integers("from", &[1, -3])
        .integers("to", &[3, 9])
        .integers("axes", &[1, 2]);
    agrees(
        sliced
            .node("Slice", &["a", "from", "to", "axes"], &["y"], &[])
            .output("y", &[2, 2, 3]),
    );
    let split = small().integers("parts", &[1, 3]).node(
        "Split",
        &["a", "parts"],
        &["p", "q"],
        &[int("axis", 2)],
    );
    agrees(
        split
            .node("Neg", &["p"], &["y"], &[])
            .node("Exp", &["q"], &["z"], &[])
            .output("y", &[2, 3, 1])
            .output("z", &[2, 3, 3]),
    );
    let gathered =
        small()
            .integers("rows", &[2, 0])
            .node("Gather", &["a", "rows"], &["y"], &[int("axis", 1)]);
    agrees(gathered.output("y", &[2, 2, 4]));
    let axes = small()
        .integers("one", &[1])
        .node("Unsqueeze", &["a", "one"], &["u"], &[])
        .node("Neg", &["u"], &["n"], &[]);
    agrees(
        axes.node("Squeeze", &["n", "one"], &["y"], &[])
            .output("y", &[2, 3, 4]),
    );
    let expanded = Small::new()
        .input("a", &[3, 1])
        .integers("s", &[2, 3, 4])
        .node("Expand", &["a", "s"], &["y"], &[]);
    agrees(expanded.output("y", &[2, 3, 4]));
    agrees(
        small()
            .node("Identity", &["a"], &["y"], &[])
            .output("y", &[2, 3, 4]),
    );
}
