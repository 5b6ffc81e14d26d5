//! Tests of attention over the cache: spellings that are understood, and those that must not be.

use std::collections::HashMap;

use lads_image::op::{CacheFormat, Op};
use lads_kernels::reference;

use super::machine::Machine;
use super::models::{Small, int, ints};
use super::oracle::{Oracle, close, tensor};
use super::{Compiled, compiled};
use crate::contract::Network;
use crate::error::CompileError;
use crate::graph::{Dim, Type};
use crate::lower::Cache;

const HEADS: usize = 2;
const DIM: usize = 3;
const WIDTH: usize = HEADS * DIM;
/// Number of rows of the cache.
const ROWS: usize = 12;

/// Differences of a spelling of attention from the exporter's.
#[derive(Clone)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "each is one deviation, tried on its own"
)]
struct Spelling {
    tokens: usize,
    mask: Vec<f32>,
    /// Scale of the scores of the past, and of the new tokens.
    scales: [f32; 2],
    /// True if the scale multiplies the queries instead of the scores.
    scale_queries: bool,
    /// True if the scores of the new tokens come first.
    swapped: bool,
    /// True if there is another mask, over the past.
    past_mask: bool,
    /// True if the output is read through its last token only.
    last_only: bool,
}

impl Spelling {
    fn new(tokens: usize) -> Self {
        let mask = (0..tokens * tokens)
            .map(|i| if i % tokens > i / tokens { -1e9 } else { 0.0 })
            .collect();
        Self {
            tokens,
            mask,
            scales: [0.5, 0.5],
            scale_queries: false,
            swapped: false,
            past_mask: false,
            last_only: false,
        }
    }

    /// Makes the model `y = attention(x·Wq, x·Wk, x·Wv)·Wo` over a cache of one layer.
    #[expect(clippy::too_many_lines, reason = "one graph, node by node")]
    fn model(&self) -> Small {
        let n = self.tokens;
        let split = [1, n as i64, HEADS as i64, DIM as i64];
        let cache = |len: Dim| [Dim::of(1), Dim::of(HEADS), len, Dim::of(DIM)];
        let mut g = Small::new()
            .input("x", &[1, n, WIDTH])
            .input_dims("past_key_values.0.key", Type::F32, &cache(Dim::past(0)))
            .input_dims("past_key_values.0.value", Type::F32, &cache(Dim::past(0)))
            .integers("split", &split)
            .integers("join", &[1, n as i64, WIDTH as i64])
            .weights("mask", &[n, n], &self.mask)
            .weights("scale_past", &[], &self.scales[..1])
            .weights("scale_new", &[], &self.scales[1..])
            .weights("past_mask", &[], &[0.25]);
        for part in ["q", "k", "v"] {
            let name = |suffix: &str| format!("{part}{suffix}");
            g = g
                .random(&name("_weight"), &[WIDTH, WIDTH])
                .node("MatMul", &["x", &name("_weight")], &[&name("_flat")], &[])
                .node(
                    "Reshape",
                    &[&name("_flat"), "split"],
                    &[&name("_split")],
                    &[],
                )
                .node(
                    "Transpose",
                    &[&name("_split")],
                    &[part],
                    &[ints("perm", &[0, 2, 1, 3])],
                );
        }
        let turn = ints("perm", &[0, 1, 3, 2]);
        let q = if self.scale_queries { "q_scaled" } else { "q" };
        g = g
            .node("Mul", &["q", "scale_new"], &["q_scaled"], &[])
            .node(
                "Concat",
                &["past_key_values.0.key", "k"],
                &["present.0.key"],
                &[int("axis", 2)],
            )
            .node(
                "Concat",
                &["past_key_values.0.value", "v"],
                &["present.0.value"],
                &[int("axis", 2)],
            )
            .node(
                "Transpose",
                &["past_key_values.0.key"],
                &["past_turned"],
                std::slice::from_ref(&turn),
            )
            .node("Transpose", &["k"], &["k_turned"], &[turn])
            .node("MatMul", &[q, "past_turned"], &["past_product"], &[])
            .node("MatMul", &[q, "k_turned"], &["new_product"], &[]);
        let (past, new) = if self.scale_queries {
            ("past_product", "new_product")
        } else {
            g = g
                .node(
                    "Mul",
                    &["past_product", "scale_past"],
                    &["past_scaled"],
                    &[],
                )
                .node("Mul", &["new_product", "scale_new"], &["new_scaled"], &[]);
            ("past_scaled", "new_scaled")
        };
        g = g.node("Add", &[new, "mask"], &["new_masked"], &[]).node(
            "Add",
            &[past, "past_mask"],
            &["past_masked"],
            &[],
        );
        let past = if self.past_mask { "past_masked" } else { past };
        let both = if self.swapped {
            ["new_masked", past]
        } else {
            [past, "new_masked"]
        };
        g = g
            .node("Concat", &both, &["scores"], &[int("axis", 3)])
            .node("Softmax", &["scores"], &["weights"], &[int("axis", -1)])
            .node("MatMul", &["weights", "present.0.value"], &["mixed"], &[])
            .node(
                "Transpose",
                &["mixed"],
                &["mixed_turned"],
                &[ints("perm", &[0, 2, 1, 3])],
            )
            .node("Reshape", &["mixed_turned", "join"], &["joined"], &[])
            .random("out", &[WIDTH, WIDTH]);
        if self.last_only {
            let last = [n as i64 - 1];
            g = g
                .node("MatMul", &["joined", "out"], &["all"], &[])
                .integers("last", &last)
                .node("Gather", &["all", "last"], &["y"], &[int("axis", 1)])
                .output("y", &[1, 1, WIDTH]);
        } else {
            g = g
                .node("MatMul", &["joined", "out"], &["y"], &[])
                .output("y", &[1, n, WIDTH]);
        }
        g.output_dims("present.0.key", Type::F32, &cache(Dim::past(n)))
            .output_dims("present.0.value", Type::F32, &cache(Dim::past(n)))
    }

    fn compile(&self) -> Result<Compiled, CompileError> {
        let small = self.model();
        compiled(&small.model(18), &small.signature, &["y"], cache())
    }
}

fn cache() -> Cache {
    let network = Network {
        layers: 1,
        heads: HEADS,
        head_dim: DIM,
    };
    Cache::new(network, ROWS, CacheFormat::F32)
}

/// Compiles, runs with some tokens in the cache and compares with tract.
#[track_caller]
fn agrees(spelling: &Spelling) -> Compiled {
    let program = spelling.compile().unwrap_or_else(|error| panic!("{error}"));
    let oracle = Oracle::new(&spelling.model().bytes(18));
    for past in [0, 1, 4] {
        let mut random = Small::new();
        let x = random.numbers(spelling.tokens * WIDTH);
        let (keys, values) = (random.numbers(past * WIDTH), random.numbers(past * WIDTH));
        let mut machine = Machine::new(
            &program.placed,
            &program.weights,
            vec![f32::NAN; cache().len().expect("a size") as usize],
        );
        machine.set(&program.placed, "x", &x);
        let [key_span, value_span] = cache().spans(0).map(|span| span.offset as usize);
        for (i, (&key, &value)) in keys.iter().zip(&values).enumerate() {
            let (head, row, col) = (i / (past * DIM), i / DIM % past, i % DIM);
            let col = head * DIM + col;
            machine.cache[key_span + reference::key(WIDTH, row, col)] = key;
            machine.cache[value_span + row * WIDTH + col] = value;
        }
        machine.run(&program.placed, past);
        let shape = [1, HEADS, past, DIM];
        let inputs = HashMap::from([
            ("x".to_string(), tensor(&[1, spelling.tokens, WIDTH], &x)),
            ("past_key_values.0.key".to_string(), tensor(&shape, &keys)),
            (
                "past_key_values.0.value".to_string(),
                tensor(&shape, &values),
            ),
        ]);
        close(
            "y",
            &machine.output(&program.placed, "y"),
            &oracle.run(&inputs)["y"],
        );
    }
    program
}

fn queries(program: &Compiled) -> Vec<u32> {
    let queries = |op: &Op| match op {
        Op::Attention(op) => Some(op.queries),
        _ => None,
    };
    program.placed.ops.iter().filter_map(queries).collect()
}

#[test]
fn any_number_of_tokens() {
    for tokens in [1, 2, 5] {
        assert_eq!(queries(&agrees(&Spelling::new(tokens))), [tokens as u32]);
    }
}

#[test]
fn the_scale_may_stand_at_the_queries() {
    agrees(&Spelling {
        scale_queries: true,
        ..Spelling::new(2)
    });
}

#[test]
fn only_the_last_query_is_computed_if_no_other_is_read() {
    assert_eq!(
        queries(&agrees(&Spelling {
            last_only: true,
            ..Spelling::new(3)
        })),
        [1]
    );
}

#[test]
fn only_recording_computes_no_query() {
    let small = Spelling::new(2).model();
    let program = compiled(&small.model(18), &small.signature, &[], cache())
        .unwrap_or_else(|error| panic!("{error}"));
    assert_eq!(queries(&program), [0]);
    assert_eq!(
        program.placed.ops.len(),
        3,
        "keys, values, record: {:?}",
        program.placed.ops
    );
}

#[test]
fn other_attentions_are_refused() {
    let base = Spelling::new(2);
    let refused = |spelling: &Spelling, problem: &str| {
        let Err(error) = spelling.compile() else {
            panic!("compiled, though {problem}")
        };
        let message = error.to_string();
        assert!(
            message.contains(problem)
                && message.contains("layer 0")
                && message.contains("test/graph"),
            "{message}"
        );
    };
    for mask in [
        vec![0.0; 4],
        vec![0.0, -10.0, 0.0, 0.0],
        vec![0.0, -1e9, -1e9, 0.0],
        vec![0.1, -1e9, 0.0, 0.0],
    ] {
        refused(
            &Spelling {
                mask,
                ..base.clone()
            },
            "mask",
        );
    }
    refused(
        &Spelling {
            scales: [0.5, 0.4],
            ..base.clone()
        },
        "different scales",
    );
    refused(
        &Spelling {
            swapped: true,
            ..base.clone()
        },
        "past keys first",
    );
    refused(
        &Spelling {
            past_mask: true,
            ..base
        },
        "mask over past tokens",
    );
}
