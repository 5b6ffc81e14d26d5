//! Tests of small models that ask for more than any policy needs: they are refused by name before
//! their constants are made, or they compile.

use super::models::{Small, int};
use super::operators::compile;
use crate::error::CompileError;
use crate::graph::MAX_FOLDING;
use crate::tensor::MAX_ELEMENTS;

/// Returns the refusal of a model, and its node.
#[track_caller]
fn refused(small: &Small) -> (String, String) {
    match compile(small) {
        Err(CompileError::Operator { node, problem, .. }) => {
            (node.to_string(), problem.to_string())
        }
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("it compiles"),
    }
}

/// Makes a model that adds the sum of constants to its input.
fn constants(shape: &[i64], most: usize) -> Small {
    let mut small = Small::new()
        .input("a", &[1])
        .output("y", &[1])
        .integers("shape", shape)
        .integers("axes", &(0..shape.len() as i64).collect::<Vec<_>>());
    let mut sum = "a".to_owned();
    for number in 0..=most {
        let [filled, reduced, next] =
            ["filled", "reduced", "sum"].map(|name| format!("{name}{number}"));
        let next = if number == most { "y".into() } else { next };
        small = small
            .node("ConstantOfShape", &["shape"], &[&filled], &[])
            .node(
                "ReduceMax",
                &[&filled, "axes"],
                &[&reduced],
                &[int("keepdims", 0)],
            )
            .node("Add", &[&sum, &reduced], &[&next], &[]);
        sum = next;
    }
    small
}

#[test]
fn one_constant_that_is_too_large() {
    for shape in [
        &[i64::MAX][..],
        &[1 << 32, 1 << 32],
        &[MAX_ELEMENTS as i64 + 1],
    ] {
        let (_, problem) = refused(&constants(shape, 0));
        assert!(problem.contains("at most"), "{problem}");
    }
}

#[test]
fn many_constants_that_are_too_large_together() {
    // Each is allowed; all of them would take gigabytes.
    let (node, problem) = refused(&constants(&[MAX_FOLDING as i64 / 8], 1000));
    assert!(problem.contains("operations"), "{problem}");
    // Each is made and read once, so the limit is reached in the fourth.
    assert_eq!(node, "ReduceMax_10");
}

#[test]
fn a_product_of_constants_that_would_take_hours() {
    // Two constants far below the limit, and a product of 2^36 multiplications.
    let small = Small::new()
        .input("a", &[1])
        .output("y", &[1])
        .integers("shape", &[4096, 4096])
        .integers("axes", &[0, 1])
        .node("ConstantOfShape", &["shape"], &["left"], &[])
        .node("MatMul", &["left", "left"], &["product"], &[])
        .node(
            "ReduceMax",
            &["product", "axes"],
            &["reduced"],
            &[int("keepdims", 0)],
        )
        .node("Add", &["a", "reduced"], &["y"], &[]);
    let (_, problem) = refused(&small);
    assert!(problem.contains("operations"), "{problem}");
}

#[test]
fn a_long_chain_compiles_or_is_refused() {
    let mut small = Small::new().input("a", &[4]).output("y", &[4]);
    let mut last = "a".to_owned();
    for number in 0..5000 {
        let next = if number == 4999 {
            "y".into()
        } else {
            format!("n{number}")
        };
        let op = if number % 2 == 0 { "Tanh" } else { "Neg" };
        small = small.node(op, &[&last], &[&next], &[]);
        last = next;
    }
    let compiled = compile(&small).unwrap_or_else(|error| panic!("{error}"));
    // In place, so a chain needs no more memory than a link.
    assert!(
        compiled.placed.arena_len <= 64,
        "{}",
        compiled.placed.arena_len
    );
}
