//! Tests of fusing several operators: layers, concatenations, tables, the LSTM; and of refusals.

use super::compiled;
use super::machine::Machine;
use super::models::{Small, float, int, text};
use super::operators::{agrees, compile, names, refused};
use crate::graph::{Dim, Type};
use crate::lower::Cache;

#[test]
fn layers_take_in_what_follows() {
    let batch_norm = Small::new()
        .input("a", &[1, 6])
        .random("w", &[8, 6])
        .random("bias", &[8])
        .random("scale", &[8])
        .random("shift", &[8])
        .random("mean", &[8])
        .weights("var", &[8], &[0.5, 1.0, 1.5, 2.0, 0.25, 3.0, 0.1, 1.0])
        .node("Gemm", &["a", "w", "bias"], &["p"], &[int("transB", 1)])
        .node(
            "BatchNormalization",
            &["p", "scale", "shift", "mean", "var"],
            &["n"],
            &[],
        )
        .node("LeakyRelu", &["n"], &["y"], &[float("alpha", 0.2)])
        .output("y", &[1, 8]);
    assert_eq!(names(&agrees(batch_norm)), ["Linear"]);

    let residual = Small::new()
        .input("a", &[2, 6])
        .random("w", &[6, 6])
        .random("v", &[6, 6])
        .random("bias", &[6])
        .node("MatMul", &["a", "w"], &["x"], &[])
        .node("MatMul", &["x", "v"], &["p"], &[])
        .node("Add", &["bias", "p"], &["q"], &[])
        .node("Relu", &["q"], &["r"], &[])
        .node("Add", &["x", "r"], &["y"], &[])
        .output("y", &[2, 6]);
    assert_eq!(names(&agrees(residual)), ["Linear", "Copy", "Linear"]);

    // The product has another reader: it stays.
    let shared = Small::new()
        .input("a", &[2, 6])
        .random("w", &[6, 6])
        .node("MatMul", &["a", "w"], &["z"], &[])
        .node("Relu", &["z"], &["y"], &[])
        .output("y", &[2, 6])
        .output("z", &[2, 6]);
    assert_eq!(names(&agrees(shared)), ["Linear", "Unary"]);
}

#[test]
fn layer_norm() {
    let small = Small::new()
        .input("a", &[3, 8])
        .random("g", &[8])
        .random("b0", &[8]);
    let small = small.node(
        "LayerNormalization",
        &["a", "g", "b0"],
        &["y"],
        &[int("axis", -1), float("epsilon", 1e-3)],
    );
    assert_eq!(names(&agrees(small.output("y", &[3, 8]))), ["LayerNorm"]);
}

#[test]
fn concatenations_are_computed_in_place() {
    let rows =
        Small::new()
            .input("a", &[1, 3])
            .input("b", &[1, 4])
            .node("Tanh", &["a"], &["t"], &[]);
    let rows = rows
        .node("Concat", &["t", "b"], &["x"], &[int("axis", 1)])
        .random("w", &[7, 5]);
    let program = agrees(
        rows.node("MatMul", &["x", "w"], &["y"], &[])
            .output("y", &[1, 5]),
    );
    assert_eq!(names(&program), ["Unary", "Linear"]);
    let columns = Small::new().input("a", &[2, 3]).input("b", &[2, 4]).node(
        "Concat",
        &["a", "b", "a"],
        &["y"],
        &[int("axis", 1)],
    );
    assert_eq!(
        names(&agrees(columns.output("y", &[2, 10]))),
        ["Copy", "Copy", "Copy"]
    );
    let twice = Small::new()
        .input("a", &[3])
        .node("Neg", &["a"], &["n"], &[]);
    let twice = twice
        .node("Concat", &["n", "n"], &["y"], &[int("axis", 0)])
        .node("Concat", &["n", "a"], &["z"], &[int("axis", 0)]);
    agrees(twice.output("y", &[6]).output("z", &[6]));
}

#[test]
fn tables_by_index() {
    let small = Small::new()
        .input_dims("i", Type::I64, &[Dim::of(1)])
        .random("table", &[5, 6])
        .integers("one", &[1])
        .node("Sub", &["i", "one"], &["before"], &[])
        .node("Gather", &["table", "before"], &["p"], &[])
        .node("Gather", &["table", "i"], &["q"], &[])
        .node("Add", &["p", "q"], &["y"], &[])
        .output("y", &[1, 6]);
    assert_eq!(names(&agrees(small)), ["GatherRow", "GatherRow", "Binary"]);
}

#[test]
fn computed_tables_by_index() {
    let queue = Small::new()
        .input_dims("i", Type::I64, &[Dim::of(1)])
        .input("a", &[5, 6])
        .node("Tanh", &["a"], &["queue"], &[])
        .node("Gather", &["queue", "i"], &["y"], &[int("axis", 0)])
        .output("y", &[1, 6]);
    assert_eq!(names(&agrees(queue)), ["Unary", "GatherRow"]);
    // Straight from the input, and a table whose rows do not lie one after the other.
    let given = Small::new()
        .input_dims("i", Type::I64, &[Dim::of(1)])
        .input("a", &[5, 6])
        .node("Transpose", &["a"], &["turned"], &[])
        .node("Gather", &["a", "i"], &["y"], &[])
        .node("Gather", &["turned", "i"], &["z"], &[])
        .output("y", &[1, 6])
        .output("z", &[1, 5]);
    agrees(given);
}

#[test]
fn lstm() {
    let (steps, batch, n, hidden) = (5, 2, 3, 4);
    let base = |directions: usize| {
        Small::new()
            .input("a", &[steps, batch, n])
            .random("w", &[directions, 4 * hidden, n])
            .random("r", &[directions, 4 * hidden, hidden])
            .random("bias", &[directions, 8 * hidden])
    };
    let operands = ["a", "w", "r", "bias"];
    let size = int("hidden_size", hidden as i64);
    let forward = base(1).node("LSTM", &operands, &["y", "z"], std::slice::from_ref(&size));
    agrees(
        forward
            .output("y", &[steps, 1, batch, hidden])
            .output("z", &[1, batch, hidden]),
    );
    let plain = base(1).node(
        "LSTM",
        &operands[..3],
        &["", "z"],
        std::slice::from_ref(&size),
    );
    agrees(plain.output("z", &[1, batch, hidden]));
    // tract reads one direction as forward whatever the attribute says, so the oracle is our own forward run over time reversed.
    let x = Small::new().numbers(steps * batch * n);
    let reversed: Vec<f32> = x.chunks(batch * n).rev().flatten().copied().collect();
    let last = |direction: &str, x: &[f32]| {
        let small = base(1).node(
            "LSTM",
            &operands,
            &["", "z"],
            &[size.clone(), text("direction", direction)],
        );
        let program = compile(&small.output("z", &[1, batch, hidden]))
            .unwrap_or_else(|error| panic!("{error}"));
        let mut machine = Machine::new(&program.placed, &program.weights, vec![]);
        machine.set(&program.placed, "a", x);
        machine.run(&program.placed, 0);
        machine.output(&program.placed, "z")
    };
    assert_eq!(last("reverse", &reversed), last("forward", &x));
    assert_ne!(last("reverse", &x), last("forward", &x));
    let both = base(2).node(
        "LSTM",
        &operands,
        &["y", "z"],
        &[size.clone(), text("direction", "bidirectional")],
    );
    agrees(
        both.output("y", &[steps, 2, batch, hidden])
            .output("z", &[2, batch, hidden]),
    );
    let start = base(1)
        .random("h", &[1, batch, hidden])
        .random("c0", &[1, batch, hidden]);
    let start = start.node(
        "LSTM",
        &["a", "w", "r", "bias", "", "h", "c0"],
        &["", "y", "z"],
        std::slice::from_ref(&size),
    );
    agrees(
        start
            .output("y", &[1, batch, hidden])
            .output("z", &[1, batch, hidden]),
    );
    // Attributes that would change the result.
    let clipped = base(1).node("LSTM", &operands, &["", "z"], &[size, float("clip", 1.0)]);
    refused(&clipped.output("z", &[1, batch, hidden]), &["LSTM", "clip"]);
}

#[test]
fn gru() {
    let (steps, batch, n, hidden) = (4, 2, 3, 5);
    let operands = ["a", "w", "r", "bias"];
    let size = int("hidden_size", hidden as i64);
    for linear_before_reset in [0, 1] {
        let attributes = [
            size.clone(),
            int("linear_before_reset", linear_before_reset),
        ];
        let base = |steps: usize| {
            Small::new()
                .input("a", &[steps, batch, n])
                .random("w", &[1, 3 * hidden, n])
                .random("r", &[1, 3 * hidden, hidden])
                .random("bias", &[1, 6 * hidden])
        };
        let all = base(steps).node("GRU", &operands, &["y", "z"], &attributes);
        agrees(
            all.output("y", &[steps, 1, batch, hidden])
                .output("z", &[1, batch, hidden]),
        );
        let plain = base(steps).node("GRU", &operands[..3], &["", "z"], &attributes);
        agrees(plain.output("z", &[1, batch, hidden]));
        // One step from a state that is given when it runs, as recurrent policies have it.
        let step = base(1).input("b", &[1, batch, hidden]).node(
            "GRU",
            &["a", "w", "r", "bias", "", "b"],
            &["", "z"],
            &attributes,
        );
        agrees(step.output("z", &[1, batch, hidden]));
        let clipped = base(steps).node(
            "GRU",
            &operands,
            &["", "z"],
            &[size.clone(), float("clip", 1.0)],
        );
        refused(&clipped.output("z", &[1, batch, hidden]), &["GRU", "clip"]);
    }
}

#[test]
fn what_is_not_supported_is_named() {
    let unknown = Small::new()
        .input("a", &[3])
        .node("Hardmax", &["a"], &["y"], &[])
        .output("y", &[3]);
    refused(
        &unknown,
        &["test/graph", "Hardmax_0", "Hardmax", "not supported"],
    );
    let attribute = Small::new()
        .input("a", &[3])
        .node("Relu", &["a"], &["y"], &[int("clipped", 6)])
        .output("y", &[3]);
    refused(&attribute, &["Relu_0", "clipped"]);
    let last = Small::new().input("a", &[1, 3]).node(
        "ArgMax",
        &["a"],
        &["j"],
        &[int("axis", 1), int("select_last_index", 1)],
    );
    refused(
        &last.output_dims("j", Type::I64, &[Dim::of(1), Dim::of(1)]),
        &["ArgMax", "select_last_index"],
    );
    let shape = Small::new()
        .input("a", &[3])
        .input("b", &[4])
        .node("Add", &["a", "b"], &["y"], &[])
        .output("y", &[4]);
    refused(&shape, &["Add_0", "[3]", "[4]", "broadcast"]);
    let output = Small::new()
        .input("a", &[3])
        .node("Relu", &["a"], &["y"], &[])
        .output("y", &[4]);
    refused(&output, &["output test/graph/y", "[3]", "[4]"]);
    let missing = Small::new()
        .input("a", &[3])
        .node("Add", &["a", "nowhere"], &["y"], &[])
        .output("y", &[3]);
    refused(&missing, &["Add_0", "nowhere"]);
    let opset = Small::new()
        .input("a", &[3])
        .node("Relu", &["a"], &["y"], &[])
        .output("y", &[3]);
    let Err(error) = compiled(&opset.model(6), &opset.signature, &["y"], Cache::NONE) else {
        panic!("compiled")
    };
    assert!(error.to_string().contains("operator set 6"), "{error}");
}
