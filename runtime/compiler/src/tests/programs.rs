//! Compares every program of the tiny bundle, and of the shipped one if present, with tract running
//! the entry that it was compiled from, for several lengths of the cache.

use std::collections::HashMap;
use std::path::Path;

use lads_kernels::reference;
use tract_onnx::prelude::Tensor;

use super::machine::Machine;
use super::oracle::{Oracle, close, integer, tensor};
use super::{Program, models::Small, programs};
use crate::bundle::Bundle;
use crate::graph::Type;

/// Lengths of the past that are tried.
const PASTS: [usize; 3] = [0, 5, 300];

fn check(path: &Path) {
    let bundle = Bundle::open(path).unwrap_or_else(|error| panic!("{error}"));
    // Room for the longest past, whatever the contract's context is.
    for program in &programs(&bundle, 310) {
        let cached = program
            .signature
            .inputs
            .iter()
            .any(|input| input.name.starts_with("past_key_values"));
        let pasts: &[usize] = if cached { &PASTS } else { &[0] };
        let oracle = Oracle::new(
            &bundle
                .entry_onnx(&program.signature.entry)
                .expect("the entry"),
        );
        for &past in pasts {
            let what = format!("{} {} past {past}", path.display(), program.entry.name);
            let case = Case {
                what,
                program,
                past,
            };
            case.check(&oracle);
        }
    }
}

/// One program at one past length.
struct Case<'a> {
    what: String,
    program: &'a Program,
    past: usize,
}

impl Case<'_> {
    fn check(&self, oracle: &Oracle) {
        let placed = &self.program.compiled.placed;
        let cache_len = self.program.cache.len().expect("a size") as usize;
        let weights = &self.program.compiled.weights;
        let mut machine = Machine::new(placed, weights, vec![f32::NAN; cache_len]);
        let mut random = Small::new();
        let mut inputs: HashMap<String, Tensor> = HashMap::new();
        for input in &self.program.signature.inputs {
            let shape: Vec<usize> = input
                .shape
                .iter()
                .map(|dim| if dim.past { self.past } else { dim.fixed })
                .collect();
            if input.ty == Type::I64 {
                machine.set(placed, &input.name, &[3.0]);
                inputs.insert(input.name.clone(), integer(3));
                continue;
            }
            let values = random.numbers(shape.iter().product());
            if input.name.starts_with("past_key_values.") {
                self.rows(&input.name, &shape)
                    .zip(&values)
                    .for_each(|(at, &value)| machine.cache[at] = value);
            } else {
                machine.set(placed, &input.name, &values);
            }
            inputs.insert(input.name.clone(), tensor(&shape, &values));
        }
        machine.run(placed, self.past);
        let wanted = oracle.run(&inputs);
        for output in &self.program.signature.outputs {
            let wanted = &wanted[&output.name];
            let what = format!("{} {}", self.what, output.name);
            let shape: Vec<usize> = output
                .shape
                .iter()
                .map(|dim| dim.fixed + if dim.past { self.past } else { 0 })
                .collect();
            if output.name.starts_with("present.") {
                let got: Vec<f32> = self
                    .rows(&output.name, &shape)
                    .map(|at| machine.cache[at])
                    .collect();
                close(&what, &got, wanted);
            } else if self.program.entry.outputs.contains(&output.name) {
                close(&what, &machine.output(placed, &output.name), wanted);
            }
        }
    }

    /// Returns the places in the cache of the elements of `[1, heads, len, head_dim]`, in that
    /// order.
    fn rows(&self, name: &str, shape: &[usize]) -> impl Iterator<Item = usize> {
        let parts: Vec<&str> = name.split('.').collect();
        let layer: usize = parts[1].parse().expect("a layer");
        let values = parts[2] == "value";
        let span = self.program.cache.spans(layer)[usize::from(values)];
        let (heads, len, dim) = (shape[1], shape[2], shape[3]);
        let width = heads * dim;
        (0..heads * len * dim).map(move |i| {
            let (head, row, col) = (i / (len * dim), i / dim % len, i % dim);
            let col = head * dim + col;
            let at = if values {
                row * width + col
            } else {
                reference::key(width, row, col)
            };
            span.offset as usize + at
        })
    }
}

#[test]
fn tiny_bundle() {
    check(Path::new(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/tests/data/tiny.onnx"
    )));
}

#[test]
fn shipped_bundle() {
    let path = Path::new(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../models/kitchen.onnx"
    ));
    if path.exists() {
        check(path);
    } else {
        println!("skipped: models/kitchen.onnx is not there yet");
    }
}
