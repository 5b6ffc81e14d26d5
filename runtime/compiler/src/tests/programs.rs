//! Every program of the tiny bundle, and of the shipped one where it is there, against tract running the entry that it was
//! compiled from, with nothing, a little and a lot in the cache.

use std::collections::HashMap;
use std::path::Path;

use lads_image::op::{CacheFormat, Port};
use lads_kernels::reference;
use tract_onnx::prelude::Tensor;

use super::machine::Machine;
use super::oracle::{Oracle, close, integer, tensor};
use super::{Compiled, compiled};
use crate::bundle::Bundle;
use crate::compile::RECIPES;
use crate::entries::{self, Signature};
use crate::graph::Type;
use crate::lower::Cache;
use crate::tests::models::Small;

/// Past lengths that are tried.
const PASTS: [usize; 3] = [0, 5, 300];

fn check(path: &Path) {
    let bundle = Bundle::open(path).unwrap_or_else(|error| panic!("{error}"));
    // Room for the longest past, whatever the contract's context is.
    let mut roomy = bundle.contract().clone();
    roomy.context.steps = roomy.context.steps.max(200);
    let cache = Cache::new(&roomy, CacheFormat::F32);
    let signatures = entries::signatures(bundle.contract());
    for recipe in &RECIPES {
        let signature = signatures
            .iter()
            .find(|signature| signature.entry == recipe.entry)
            .expect("an entry");
        let program = compiled(
            &bundle.model,
            signature,
            recipe.outputs,
            recipe.ports,
            cache,
        )
        .unwrap_or_else(|error| panic!("{error}"));
        let cached = signature
            .inputs
            .iter()
            .any(|input| input.name.starts_with("past_key_values"));
        let pasts: &[usize] = if cached { &PASTS } else { &[0] };
        let oracle = Oracle::new(&bundle.entry_onnx(recipe.entry).expect("the entry"));
        for &past in pasts {
            let what = format!("{} {} past {past}", path.display(), recipe.name);
            let case = Case {
                what,
                signature,
                program: &program,
                cache,
                past,
            };
            case.check(recipe.ports, &oracle);
        }
    }
}

/// One program at one past length.
struct Case<'a> {
    what: String,
    signature: &'a Signature,
    program: &'a Compiled,
    cache: Cache,
    past: usize,
}

impl Case<'_> {
    fn check(&self, ports: &[(&str, Port)], oracle: &Oracle) {
        let port = |name: &str| {
            ports
                .iter()
                .find(|(known, _)| *known == name)
                .map(|&(_, port)| port)
        };
        let placed = &self.program.placed;
        let cache_len = self.cache.len().expect("a size") as usize;
        let mut machine = Machine::new(placed, &self.program.weights, vec![f32::NAN; cache_len]);
        let mut random = Small::new();
        let mut inputs: HashMap<String, Tensor> = HashMap::new();
        for input in &self.signature.inputs {
            let shape: Vec<usize> = input
                .shape
                .iter()
                .map(|dim| if dim.past { self.past } else { dim.fixed })
                .collect();
            if input.ty == Type::I64 {
                machine.set(placed, port(&input.name).expect("a port"), &[3.0]);
                inputs.insert(input.name.clone(), integer(3));
                continue;
            }
            let values = random.numbers(shape.iter().product());
            if let Some(port) = port(&input.name) {
                machine.set(placed, port, &values);
            } else {
                self.rows(&input.name, &shape)
                    .zip(&values)
                    .for_each(|(at, &value)| machine.cache[at] = value);
            }
            inputs.insert(input.name.clone(), tensor(&shape, &values));
        }
        machine.run(placed, self.past);
        let wanted = oracle.run(&inputs);
        for output in &self.signature.outputs {
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
            } else if port(&output.name)
                .is_some_and(|port| placed.outputs.iter().any(|(found, _)| *found == port))
            {
                close(
                    &what,
                    &machine.output(placed, port(&output.name).expect("a port")),
                    wanted,
                );
            }
        }
    }

    /// Where the cache holds the elements of `[1, heads, len, head_dim]`, in that order.
    fn rows(&self, name: &str, shape: &[usize]) -> impl Iterator<Item = usize> {
        let parts: Vec<&str> = name.split('.').collect();
        let layer: usize = parts[1].parse().expect("a layer");
        let values = parts[2] == "value";
        let span = self.cache.spans(layer)[usize::from(values)];
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
