//! Runs ONNX's own node conformance tests, through compilation and the core's executor, on every
//! instruction set.
//!
//! The cases are made by `tests/parity/test_onnx_nodes.py` from the `onnx` package, one model per
//! file in the folder that [`FOLDER`] names: its inputs are called `a` to `e`, its outputs `y`, `z`
//! or `j`, and the given inputs and expected outputs are among the initializers, as `given/a` and
//! `expected/y`. Without the variable the test has nothing to do, so it is ignored.

use std::collections::{BTreeMap, HashMap};

use lads_core::Isa;

use lads_image::op::{INT_SLOTS, Op, Place};
use lads_image::{Machine, Program, Spaces};
use prost::Message;

use super::models::ENTRY;
use super::{Compiled, compiled, doubles};
use crate::entries::{Signature, Value};
use crate::error::CompileError;
use crate::graph::{Dim, Type};
use crate::lower::Cache;
use crate::onnx::ModelProto;
use crate::tensor::{Data, Tensor};

const FOLDER: &str = "LADS_ONNX_NODES";

/// One conformance test.
struct Case {
    model: ModelProto,
    given: HashMap<String, Tensor>,
    expected: HashMap<String, Tensor>,
}

impl Case {
    fn read(bytes: &[u8]) -> Self {
        let mut model = ModelProto::decode(bytes).expect("a model");
        let graph = model.graph.as_mut().expect("a graph");
        let mut take = |prefix: &str| -> HashMap<String, Tensor> {
            let found = graph.initializer.iter().filter_map(|tensor| {
                let name = tensor.name.strip_prefix(prefix)?;
                let value = Tensor::from_proto(tensor).expect("a tensor");
                Some((name.to_string(), (*value).clone()))
            });
            let found = found.collect();
            graph
                .initializer
                .retain(|tensor| !tensor.name.starts_with(prefix));
            found
        };
        let (given, expected) = (take("given/"), take("expected/"));
        Self {
            model,
            given,
            expected,
        }
    }

    /// Turns the inputs from the `runtime`-th on into constants, as an exporter would for a scale
    /// or for axes.
    fn exported(&self, runtime: usize) -> (ModelProto, Signature) {
        let mut model = self.model.clone();
        let graph = model.graph.as_mut().expect("a graph");
        let mut inputs: Vec<&String> = self.given.keys().collect();
        inputs.sort();
        let constants = inputs.split_off(runtime.min(inputs.len()));
        for name in constants {
            let mut tensor = crate::onnx::TensorProto {
                name: format!("{ENTRY}/{name}"),
                dims: self.given[name]
                    .shape
                    .iter()
                    .map(|&dim| dim as i64)
                    .collect(),
                ..Default::default()
            };
            let Data::F32(data) = &self.given[name].data else {
                panic!("inputs are floats");
            };
            tensor.data_type = crate::onnx::data_type::FLOAT;
            tensor.float_data.clone_from(data);
            graph.initializer.push(tensor);
        }
        let value = |name: &String, tensor: &Tensor| Value {
            name: name.clone(),
            ty: if matches!(tensor.data, Data::F32(_)) {
                Type::F32
            } else {
                Type::I64
            },
            shape: tensor.shape.iter().map(|&dim| Dim::of(dim)).collect(),
            fields: "test".into(),
        };
        let mut outputs: Vec<&String> = self.expected.keys().collect();
        outputs.sort();
        let signature = Signature {
            entry: ENTRY.into(),
            inputs: inputs
                .iter()
                .map(|&name| value(name, &self.given[name]))
                .collect(),
            outputs: outputs
                .iter()
                .map(|&name| value(name, &self.expected[name]))
                .collect(),
        };
        (model, signature)
    }

    /// Evaluates the graph in double precision and compares.
    fn check_evaluated(&self, name: &str, (model, signature): &(ModelProto, Signature)) {
        let numbers = |(name, tensor): (&String, &Tensor)| {
            let data = tensor.as_f32().expect("inputs are floats");
            (name.clone(), data.to_vec())
        };
        let given = self.given.iter().map(numbers).collect();
        for (output, got) in doubles::outputs(model, signature, &given) {
            same(&format!("{name} evaluated"), &got, &self.expected[&output]);
        }
    }

    /// Runs the program in the core and compares.
    fn check(&self, name: &str, program: &Compiled) {
        let placed = &program.placed;
        let ops: Vec<_> = placed.ops.iter().map(Op::encode).collect();
        let spaces = Spaces {
            weights_len: program.weights.len(),
            cache_len: 0,
            rows: 0,
        };
        let places = placed.inputs.iter().chain(&placed.outputs);
        let places = places.map(|&(_, place)| place);
        let opened = Program::new_checked(&ops, placed.arena_len, 0, spaces, places);
        let opened = opened.unwrap_or_else(|error| panic!("{name}: {error}"));
        for isa in Isa::all() {
            let mut arena = vec![f32::NAN; opened.arena_len()];
            for (input, place) in &placed.inputs {
                let given = self.given.get(input).and_then(Tensor::as_f32);
                match (place, given) {
                    (Place::Span(span), Some(given)) => arena[span.range()].copy_from_slice(given),
                    _ => panic!("{name}: {input} is no input of floats"),
                }
            }
            let mut machine = Machine {
                arena: &mut arena,
                cache: &mut [],
                ints: [0; INT_SLOTS],
                past: 0,
                isa,
            };
            let done = opened.run(&program.weights, &mut machine);
            done.unwrap_or_else(|error| panic!("{name}: {error}"));
            let ints = machine.ints;
            for (output, expected) in &self.expected {
                let found = placed.outputs.iter().find(|(known, _)| known == output);
                let got: Vec<f32> = match found.expect("an output").1 {
                    Place::Span(span) => arena[span.range()].to_vec(),
                    Place::Int(slot) => vec![ints[usize::from(slot.0)] as f32],
                };
                same(&format!("{name} on {isa:?}"), &got, expected);
            }
        }
    }
}

fn compile((model, signature): &(ModelProto, Signature)) -> Result<Compiled, CompileError> {
    let outputs = signature.outputs.iter();
    let names: Vec<&str> = outputs.map(|output| output.name.as_str()).collect();
    compiled(model, signature, &names, Cache::NONE)
}

/// Asserts equality within the tolerance of ONNX's own runner.
fn same(what: &str, got: &[f32], expected: &Tensor) {
    let expected: Vec<f32> = match &expected.data {
        Data::F32(data) => data.clone(),
        Data::I64(data) => data.iter().map(|&x| x as f32).collect(),
    };
    assert_eq!(got.len(), expected.len(), "{what}");
    for (&got, expected) in got.iter().zip(expected) {
        let same = got == expected || got.is_nan() && expected.is_nan();
        let near = (got - expected).abs() <= 1e-7 + 1e-3 * expected.abs();
        assert!(same || near, "{what}: {got} instead of {expected}");
    }
}

#[test]
#[ignore = "needs the cases that tests/parity/test_onnx_nodes.py makes, in LADS_ONNX_NODES"]
fn onnx_node_cases() {
    let folder = std::env::var_os(FOLDER)
        .unwrap_or_else(|| panic!("{FOLDER} names no folder; run tests/parity/test_onnx_nodes.py"));
    let mut paths: Vec<_> = std::fs::read_dir(&folder)
        .expect("the folder can be read")
        .map(|entry| entry.expect("it can be read").path())
        .collect();
    paths.sort();
    let (mut passed, mut refused) = (BTreeMap::<String, usize>::new(), 0);
    for path in &paths {
        let name = path.file_stem().expect("a name").to_string_lossy();
        let case = Case::read(&std::fs::read(path).expect("it can be read"));
        let nodes = &case.model.graph.as_ref().expect("a graph").node;
        let operators: Vec<String> = nodes.iter().map(|node| node.op_type.clone()).collect();
        // As many inputs as possible are given when the program runs.
        let attempts = (0..=case.given.len())
            .rev()
            .map(|runtime| case.exported(runtime));
        let mut last = None;
        let found = attempts.into_iter().find_map(|exported| {
            let program = compile(&exported).map_err(|error| last = Some(error));
            Some((program.ok()?, exported))
        });
        match (found, last) {
            (Some((program, exported)), _) => {
                case.check(&name, &program);
                case.check_evaluated(&name, &exported);
                for operator in operators {
                    *passed.entry(operator).or_default() += 1;
                }
            }
            (None, Some(CompileError::Operator { operator, .. })) => {
                assert!(
                    operators.contains(&operator.to_string()),
                    "{name}: {operator} is named"
                );
                refused += 1;
            }
            (None, Some(CompileError::Entry { .. })) => refused += 1,
            (None, error) => panic!("{name}: {error:?}"),
        }
    }
    let total: usize = paths.len() - refused;
    println!(
        "{total} cases agree, {refused} are refused with a named error; agreeing by operator: {passed:?}"
    );
    // Operators that the crate says it compiles: each has a case that agrees.
    let documented = include_str!("../lib.rs")
        .split("```text")
        .nth(2)
        .expect("the list");
    let documented = documented
        .split("```")
        .next()
        .expect("the list")
        .replace("//!", "");
    let without: Vec<&str> = (documented.split_whitespace())
        .filter(|operator| !passed.contains_key(*operator))
        .collect();
    // The package's cases of these search several rows, have inputs or sequences that no entry has, or numbers of 64 bits; what
    // policy files of the field have of them is compared with tract in `field.rs`, or with ONNX Runtime by `tests/parity/test_import.py`.
    let left = [
        "ArgMax",
        "ArgMin",
        "ConcatFromSequence",
        "Einsum",
        "Not",
        "SequenceAt",
        "SequenceConstruct",
        "SequenceEmpty",
        "SequenceInsert",
        "SequenceLength",
        "SplitToSequence",
        "Tile",
    ];
    assert_eq!(without, left);
}
