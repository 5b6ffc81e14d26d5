//! Prints the table of `make mutate`: every change of a bundle, what it moves, and the verdict on it.
//!
//! Exit code 1 if fewer than 98 % of the changes that move a logit by more than 1e-2, an action by more than 1e-4 or an encoding are DIFFERENT, or if one
//! that is harmless is.

#[path = "../tests/common/mutate.rs"]
mod mutate;

use std::path::PathBuf;
use std::process::ExitCode;

use lads_compiler::{CacheFormat, Options, Storage, WeightFormat};
use lads_proof::reference::Reference;
use mutate::{Model, Normals, Outcome};

/// Difference of a logit from which on a change must be found.
const LOGIT: f64 = 1e-2;
const ACTION: f64 = 1e-4;
const FOUND: f64 = 0.98;

/// Counts of one kind of change.
#[derive(Default)]
struct Kind {
    name: String,
    /// Whether none may be DIFFERENT.
    harmless: bool,
    changes: usize,
    refused: usize,
    different: usize,
    moving: usize,
    found: usize,
    exceptions: Vec<String>,
    refusals: Vec<String>,
}

struct Bench {
    reference: Reference,
    every: usize,
}

impl Bench {
    fn add(&self, kind: &mut Kind, what: &str, bytes: &[u8], options: &Options) {
        kind.changes += 1;
        let judged = match mutate::verify(bytes, options, &self.reference, self.every) {
            Outcome::Judged(judged) => judged,
            Outcome::Refused(why) => {
                kind.refused += 1;
                kind.refusals.push(format!("{what}: {why}"));
                return;
            }
        };
        // With fewer bits than 32 the logits count by what they decide; their values, and what moves them, with 32.
        let answers = &judged.asked.policy;
        let exact = judged.asked.exact.as_ref().unwrap_or(answers);
        let (logit, action) = (
            exact.largest_logit_difference,
            answers.largest_action_difference,
        );
        let moving = logit > LOGIT || action > ACTION || answers.differing_segments > 0;
        let different = judged.different();
        kind.different += usize::from(different);
        kind.moving += usize::from(moving);
        kind.found += usize::from(moving && different);
        // What a contract says need not move anything here.
        let said = !judged.contract.differing.is_empty();
        let wrong = if kind.harmless {
            different
        } else {
            moving != different && !said
        };
        if wrong {
            let verdict = if different {
                "DIFFERENT"
            } else {
                "no difference"
            };
            let segments = answers.differing_segments;
            let reason = judged.reason();
            kind.exceptions.push(format!(
                "{what}: {verdict}; largest logit {logit:.1e}, action {action:.1e}, segments encoded as another plan {segments} {reason}"
            ));
        }
    }
}

fn weights(model: &Model, bench: &Bench) -> Vec<Kind> {
    type Change = fn(&mut [f32], usize, &mut Normals);
    let changes: [(&str, Change); 4] = [
        ("times 1.01", |values, _, _| mutate::scale(values, 1.01)),
        ("zero", |values, _, _| values.fill(0.0)),
        ("noise of 1e-3", |values, _, normals| {
            for x in values {
                *x *= 1.0 + 1e-3 * normals.next();
            }
        }),
        ("two rows swapped", |values, rows, _| {
            let row = values.len() / rows.max(1);
            if rows > 1 {
                let (first, rest) = values.split_at_mut(row);
                first.swap_with_slice(&mut rest[..row]);
            }
        }),
    ];
    let all = changes.into_iter().map(|(name, change)| {
        let mut kind = Kind {
            name: format!("weights {name}"),
            ..Kind::default()
        };
        for tensor in &model.tensors {
            let mut changed = model.clone();
            let mut normals = Normals::new(1);
            changed.edit(&tensor.name, |values| {
                change(values, tensor.rows, &mut normals);
            });
            if changed.bytes() != model.bytes() {
                bench.add(&mut kind, &tensor.name, changed.bytes(), &Options::exact());
            }
        }
        kind
    });
    all.collect()
}

fn contract(model: &Model, bench: &Bench) -> Kind {
    let mut kind = Kind {
        name: "contract".to_owned(),
        ..Kind::default()
    };
    let mut kinds = std::collections::BTreeSet::new();
    for (pointer, changed) in mutate::contracts(&model.contract()) {
        let parts: String = pointer
            .split('/')
            .filter(|part| part.parse::<usize>().is_err())
            .collect();
        if kinds.insert(parts) {
            bench.add(
                &mut kind,
                &pointer,
                model.with_contract(&changed).bytes(),
                &Options::exact(),
            );
        }
    }
    kind
}

fn options(model: &Model, bench: &Bench) -> Kind {
    let mut kind = Kind {
        name: "image options".to_owned(),
        ..Kind::default()
    };
    let formats = [
        WeightFormat::F32,
        WeightFormat::F16,
        WeightFormat::Bf16,
        WeightFormat::Int16,
        WeightFormat::Int8,
    ];
    for weights in formats {
        for low_level in [weights, WeightFormat::F32] {
            for cache in [CacheFormat::F32, CacheFormat::F16] {
                let storage = Storage::of_weights(weights)
                    .with_part("low_level/act", low_level)
                    .with_cache(cache);
                let what = storage.to_string();
                let options = Options {
                    storage: Some(storage),
                    force: true,
                    ..Options::default()
                };
                bench.add(&mut kind, &what, model.bytes(), &options);
            }
        }
    }
    kind
}

fn harmless(model: &Model, bench: &Bench) -> Kind {
    let mut kind = Kind {
        name: "harmless".to_owned(),
        harmless: true,
        ..Kind::default()
    };
    bench.add(&mut kind, "nothing", model.bytes(), &Options::exact());
    for seed in 0..10 {
        let noisy = mutate::noisy(model, 1e-6, 100 + seed);
        bench.add(
            &mut kind,
            &format!("noise of 1e-6 on all weights, seed {seed}"),
            noisy.bytes(),
            &Options::exact(),
        );
    }
    for step in [1, 7] {
        let renumbered = mutate::renumbered(model, step);
        bench.add(
            &mut kind,
            &format!("plans renumbered by {step}"),
            renumbered.bytes(),
            &Options::exact(),
        );
    }
    kind
}

fn main() -> ExitCode {
    let mut arguments = std::env::args_os().skip(1);
    let (Some(path), every) = (arguments.next().map(PathBuf::from), arguments.next()) else {
        eprintln!("mutate MODEL [EVERY]: name a bundle with a reference beside it");
        return ExitCode::from(2);
    };
    let every = every
        .and_then(|text| text.to_str()?.parse().ok())
        .unwrap_or(1);
    let reference = match Reference::open(&path.with_extension("reference.json")) {
        Ok(reference) => reference,
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::from(2);
        }
    };
    let (model, bench) = (Model::open(&path), Bench { reference, every });
    let mut kinds = weights(&model, &bench);
    kinds.push(contract(&model, &bench));
    kinds.push(options(&model, &bench));
    let harmless = harmless(&model, &bench);
    println!(
        "| change | number | refused | DIFFERENT | move a logit > {LOGIT}, an action > {ACTION} or an encoding | of these DIFFERENT |"
    );
    println!("|---|---|---|---|---|---|");
    for kind in kinds.iter().chain([&harmless]) {
        println!(
            "| {} | {} | {} | {} | {} | {} |",
            kind.name, kind.changes, kind.refused, kind.different, kind.moving, kind.found
        );
    }
    println!("\nWhere verdict and movement do not agree:\n");
    for kind in kinds.iter().chain([&harmless]) {
        kind.exceptions
            .iter()
            .for_each(|what| println!("- {}: {what}", kind.name));
    }
    println!("\nRefused before anything runs:\n");
    for kind in kinds.iter().chain([&harmless]) {
        kind.refusals
            .iter()
            .for_each(|what| println!("- {}: {what}", kind.name));
    }
    let moving: usize = kinds.iter().map(|kind| kind.moving).sum();
    let found: usize = kinds.iter().map(|kind| kind.found).sum();
    let share = found as f64 / moving.max(1) as f64;
    println!(
        "\n{found} of {moving} changes that move something are DIFFERENT: {:.1} %; {} harmless ones are.",
        100.0 * share,
        harmless.different
    );
    ExitCode::from(u8::from(share < FOUND || harmless.different > 0))
}
