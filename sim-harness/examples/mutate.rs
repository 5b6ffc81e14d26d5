//! Prints the tables of `make mutate`: every change of a bundle, what it moves, the verdict on it, and what is left of its success.
//!
//! Success is that of the first episode of some instructions in closed loop, seeded as the reference's. So few episodes say what a change destroys and
//! not by how much it is worse: how far they move by themselves is what the harmless changes show, and stands beside the summary.
//!
//! Exit code 1 if fewer than 98 % of the changes that move a logit by more than 1e-2, an action by more than 1e-4, an encoding, or with fewer bits a
//! decision are DIFFERENT, or if one is that moves less or is harmless; 2 if something that was named cannot be used. An image with fewer bits may also be
//! DIFFERENT because too few decisions are clear by what its logits move, as a certificate's rule says.

#[path = "../tests/common/drive.rs"]
mod drive;
#[path = "../tests/common/mutate.rs"]
mod mutate;

use std::collections::BTreeSet;
use std::fmt::{self, Write as _};
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::process::ExitCode;
use std::thread::available_parallelism;

use clap::Parser;
use drive::{Outcome, Rollouts};
use lads_compiler::{CacheFormat, Options, Storage, WeightFormat};
use lads_proof::reference::Reference;
use lads_sim::{command, output};
use mutate::{ACTION, Judged, LOGIT, Model, Moved, Normals};

/// Share of the changes that move something that has to be DIFFERENT.
const FOUND: f64 = 0.98;

/// Changes a bundle in every way and verifies each change.
#[derive(Parser)]
struct Arguments {
    /// The bundle; its reference lies beside it.
    model: PathBuf,
    /// Asks about the first traced episode of each so many instructions.
    #[arg(long, default_value = "1")]
    every: NonZeroUsize,
    /// Runs the first episode of each so many instructions in closed loop.
    #[arg(long, default_value = "3")]
    run_every: NonZeroUsize,
    /// Tries these kinds of changes only, besides those that are harmless: `weights`, `contract` or `options`.
    #[arg(long, value_enum)]
    only: Vec<Kind>,
    /// Writes the summary and the row of each change to a file, too.
    #[arg(short, long)]
    output: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Kind {
    Weights,
    Contract,
    Options,
}

/// One change and what came of it.
struct Row {
    kind: &'static str,
    what: String,
    seen: Seen,
}

enum Seen {
    /// The bundle does not open or compile, and the reason.
    Refused(String),
    Judged {
        judged: Box<Judged>,
        /// Episodes in closed loop, or why they do not run.
        outcomes: Result<Vec<Outcome>, String>,
    },
}

impl Row {
    fn is_harmless(&self) -> bool {
        self.kind == HARMLESS
    }

    fn judged(&self) -> Option<&Judged> {
        match &self.seen {
            Seen::Refused(_) => None,
            Seen::Judged { judged, .. } => Some(judged),
        }
    }

    fn is_different(&self) -> bool {
        self.judged().is_some_and(Judged::different)
    }

    fn moves(&self) -> bool {
        self.judged().is_some_and(|it| it.moved().is_much())
    }

    fn outcomes(&self) -> Option<&[Outcome]> {
        match &self.seen {
            Seen::Judged {
                outcomes: Ok(outcomes),
                ..
            } => Some(outcomes),
            _ => None,
        }
    }

    fn successes(&self) -> Option<usize> {
        let outcomes = self.outcomes()?;
        Some(outcomes.iter().filter(|it| it.success).count())
    }

    /// Whether the verdict is wrong: it moves and was not found, or was found and moves little. What a contract says need not move anything here.
    fn is_wrong(&self) -> bool {
        let Some(judged) = self.judged() else {
            return false;
        };
        let (moved, different) = (judged.moved(), judged.different());
        let said = !judged.contract.differing.is_empty();
        if self.is_harmless() || moved.is_little() && !said {
            different
        } else {
            moved.is_much() && !different
        }
    }
}

/// The row of a table, with what the verdict names first.
impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "| {} | {} |", self.kind, self.what)?;
        let (judged, outcomes) = match &self.seen {
            Seen::Refused(why) => return write!(f, " refused | | | | | | | {} |", cell(why)),
            Seen::Judged { judged, outcomes } => (judged, outcomes),
        };
        let verdict = match judged.asked.undecided() {
            _ if judged.different() => "DIFFERENT",
            Some(_) => "INCONCLUSIVE",
            None => "same",
        };
        let Moved {
            logit,
            action,
            segments,
            decisions,
            ..
        } = judged.moved();
        let moved = format!("{logit:.1e} | {action:.1e} | {segments} | {decisions}");
        write!(f, " {verdict} | {moved} |")?;
        match outcomes {
            Ok(outcomes) => {
                let done: usize = outcomes.iter().map(|it| it.sub_tasks.len()).sum();
                let success = self.successes().unwrap_or_default();
                write!(f, " {success} | {done} | {} |", cell(&judged.reason()))
            }
            Err(why) => write!(
                f,
                " - | - | {}; does not run: {} |",
                cell(&judged.reason()),
                cell(why)
            ),
        }
    }
}

/// A text as it can stand in a table's cell.
fn cell(text: &str) -> String {
    text.replace('|', "\\|").replace('\n', " ")
}

const HARMLESS: &str = "harmless";

struct Bench {
    model: Model,
    reference: Reference,
    rollouts: Rollouts,
    every: usize,
    rows: Vec<Row>,
}

impl Bench {
    /// Verifies and runs one change, and prints its row.
    fn add(&mut self, kind: &'static str, what: &str, bytes: &[u8], options: &Options) {
        let seen = match mutate::open(bytes, options) {
            Err(why) => Seen::Refused(why),
            Ok(opened) => Seen::Judged {
                judged: Box::new(mutate::judge(&opened, &self.reference, self.every)),
                outcomes: self.rollouts.run(&opened),
            },
        };
        let row = Row {
            kind,
            what: what.to_owned(),
            seen,
        };
        println!("{row}");
        self.rows.push(row);
    }
}

fn harmless(bench: &mut Bench) {
    let model = bench.model.clone();
    bench.add(HARMLESS, "nothing", model.bytes(), &Options::exact());
    for seed in 0..10 {
        let noisy = mutate::noisy(&model, 1e-6, 100 + seed);
        let what = format!("noise of 1e-6 on all weights, seed {seed}");
        bench.add(HARMLESS, &what, noisy.bytes(), &Options::exact());
    }
    for step in [1, 7] {
        let renumbered = mutate::renumbered(&model, step);
        let what = format!("plans renumbered by {step}");
        bench.add(HARMLESS, &what, renumbered.bytes(), &Options::exact());
    }
}

fn weights(bench: &mut Bench) {
    type Change = fn(&mut [f32], usize, &mut Normals);
    let changes: [(&'static str, Change); 4] = [
        ("weights times 1.01", |values, _, _| {
            mutate::scale(values, 1.01);
        }),
        ("weights zero", |values, _, _| values.fill(0.0)),
        ("weights noise of 1e-3", |values, _, normals| {
            for x in values {
                *x *= 1.0 + 1e-3 * normals.next();
            }
        }),
        ("weights two rows swapped", |values, rows, _| {
            let row = values.len() / rows.max(1);
            if rows > 1 {
                let (first, rest) = values.split_at_mut(row);
                first.swap_with_slice(&mut rest[..row]);
            }
        }),
    ];
    let model = bench.model.clone();
    for (kind, change) in changes {
        for tensor in &model.tensors {
            let mut changed = model.clone();
            let mut normals = Normals::new(1);
            changed.edit(&tensor.name, |values| {
                change(values, tensor.rows, &mut normals);
            });
            if changed.bytes() != model.bytes() {
                bench.add(kind, &tensor.name, changed.bytes(), &Options::exact());
            }
        }
    }
}

fn contract(bench: &mut Bench) {
    let model = bench.model.clone();
    let mut kinds = BTreeSet::new();
    for (pointer, changed) in mutate::contracts(&model.contract()) {
        let parts: String = pointer
            .split('/')
            .filter(|part| part.parse::<usize>().is_err())
            .collect();
        if kinds.insert(parts) {
            let changed = model.with_contract(&changed);
            bench.add("contract", &pointer, changed.bytes(), &Options::exact());
        }
    }
}

fn options(bench: &mut Bench) {
    let model = bench.model.clone();
    let mut tried = BTreeSet::new();
    let mut storages = vec![("as tuned".to_owned(), None)];
    for weights in WeightFormat::ALL {
        for low_level in [weights, WeightFormat::F32] {
            for cache in CacheFormat::ALL {
                let storage = Storage::of_weights(weights)
                    .with_part("low_level/act", low_level)
                    .with_cache(cache);
                storages.push((storage.to_string(), Some(storage)));
            }
        }
    }
    for (what, storage) in storages {
        let options = Options {
            storage,
            // The reference is to find what the golden episode would.
            force: true,
            ..Options::default()
        };
        if tried.insert(what.clone()) {
            bench.add("image options", &what, model.bytes(), &options);
        }
    }
}

/// What the rows say together.
struct Summary<'r> {
    model: String,
    rows: &'r [Row],
    /// Number of traced episodes whose questions were asked.
    asked: usize,
    /// Number of episodes in closed loop.
    episodes: usize,
    commanded: usize,
}

impl Summary<'_> {
    fn kinds(&self) -> Vec<&'static str> {
        let mut kinds = Vec::new();
        for row in self.rows {
            if !kinds.contains(&row.kind) {
                kinds.push(row.kind);
            }
        }
        kinds
    }

    /// Least and most successes of the harmless changes: the noise of so few episodes.
    fn noise(&self) -> [usize; 2] {
        let harmless = self.rows.iter().filter(|row| row.is_harmless());
        let successes: Vec<_> = harmless.filter_map(Row::successes).collect();
        let [least, most] = [successes.iter().min(), successes.iter().max()];
        [least, most].map(|it| it.copied().unwrap_or_default())
    }

    /// Whether a change leaves fewer or more successes than any harmless one, or does not run.
    fn moves_success(&self, row: &Row) -> bool {
        let [least, most] = self.noise();
        let runs = row.judged().is_some();
        runs && row
            .successes()
            .is_none_or(|successes| !(least..=most).contains(&successes))
    }

    /// Numbers of changes that move something, and of those that are DIFFERENT.
    fn found(&self) -> [usize; 2] {
        let moving = || {
            let rows = self.rows.iter().filter(|row| !row.is_harmless());
            rows.filter(|row| row.moves())
        };
        let found = moving().filter(|row| row.is_different()).count();
        [moving().count(), found]
    }

    /// Number of changes that are DIFFERENT though they move little or are harmless.
    fn alarms(&self) -> usize {
        let wrong = self.rows.iter().filter(|row| row.is_wrong());
        wrong.filter(|row| row.is_different()).count()
    }

    fn passes(&self) -> bool {
        let [moving, found] = self.found();
        found as f64 >= FOUND * moving as f64 && self.alarms() == 0
    }
}

impl fmt::Display for Summary<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [least, most] = self.noise();
        writeln!(
            f,
            "{}: what moves is measured on {} traced episodes. Success is that of {} episodes in closed loop with {} sub-tasks, each the first of its \
             instruction and seeded as the reference's; harmless changes leave {least} to {most} successes, which is the noise.\n",
            self.model, self.asked, self.episodes, self.commanded
        )?;
        writeln!(
            f,
            "| change | number | refused | DIFFERENT | move a logit > {LOGIT}, an action > {ACTION}, an encoding, or with fewer bits a decision | of these \
             DIFFERENT | move the success beyond the noise | of these DIFFERENT |\n|---|---|---|---|---|---|---|---|"
        )?;
        for kind in self.kinds() {
            let rows: Vec<_> = self.rows.iter().filter(|row| row.kind == kind).collect();
            let count = |is: &dyn Fn(&Row) -> bool| rows.iter().filter(|row| is(row)).count();
            writeln!(
                f,
                "| {kind} | {} | {} | {} | {} | {} | {} | {} |",
                rows.len(),
                count(&|row| row.judged().is_none()),
                count(&Row::is_different),
                count(&Row::moves),
                count(&|row| row.moves() && row.is_different()),
                count(&|row| self.moves_success(row)),
                count(&|row| self.moves_success(row) && row.is_different()),
            )?;
        }
        let [moving, found] = self.found();
        let share = 100.0 * found as f64 / moving.max(1) as f64;
        writeln!(
            f,
            "\n{found} of {moving} changes that move something are DIFFERENT: {share:.1} %; {} that move less or are harmless are.",
            self.alarms()
        )?;
        let unseen = |row: &&Row| self.moves_success(row) && !row.is_different();
        for (title, rows) in [
            (
                "Where verdict and movement do not agree",
                self.rows.iter().filter(|row| row.is_wrong()).collect(),
            ),
            (
                "Where the success is beyond the noise without a difference",
                self.rows.iter().filter(unseen).collect::<Vec<_>>(),
            ),
        ] {
            if !rows.is_empty() {
                writeln!(f, "\n{title}:\n\n{HEADING}")?;
                rows.iter().try_for_each(|row| writeln!(f, "{row}"))?;
            }
        }
        Ok(())
    }
}

const HEADING: &str = "| kind | change | verdict | largest logit | largest action | segments encoded otherwise | decisions otherwise | successes | \
                       sub-tasks done | first reason |\n|---|---|---|---|---|---|---|---|---|---|";

fn run(arguments: &Arguments) -> Result<bool, String> {
    type Changes = fn(&mut Bench);
    let outputs = arguments.output.iter();
    let outputs: Vec<_> = outputs.map(|path| ("--output", path.as_path())).collect();
    let (model, beside) = (
        &arguments.model,
        arguments.model.with_extension("reference.json"),
    );
    let inputs = [("MODEL", model.as_path()), ("the reference", &beside)];
    output::check(&inputs, &outputs).map_err(|error| error.to_string())?;
    let reference = Reference::open(&beside).map_err(|error| error.to_string())?;
    let bytes = std::fs::read(model).map_err(|error| format!("{}: {error}", model.display()))?;
    let opened = mutate::open(&bytes, &Options::exact())?;
    let threads = available_parallelism().map_or(1, NonZeroUsize::get);
    let rollouts = Rollouts::new(&opened, &reference, arguments.run_every.get(), threads);
    let mut bench = Bench {
        model: Model::open(model),
        reference,
        rollouts,
        every: arguments.every.get(),
        rows: Vec::new(),
    };
    println!("{HEADING}");
    harmless(&mut bench);
    let kinds: [(Kind, Changes); 3] = [
        (Kind::Weights, weights),
        (Kind::Contract, contract),
        (Kind::Options, options),
    ];
    let only = &arguments.only;
    for (_, changes) in kinds
        .into_iter()
        .filter(|(kind, _)| only.is_empty() || only.contains(kind))
    {
        changes(&mut bench);
    }
    let summary = Summary {
        model: model.display().to_string(),
        asked: bench.reference.instructions.len().div_ceil(bench.every),
        episodes: bench.rows[0].outcomes().map_or(0, <[_]>::len),
        commanded: bench.rollouts.commanded(),
        rows: &bench.rows,
    };
    println!("\n{summary}");
    for (_, path) in outputs {
        let mut page = format!("{summary}\n{HEADING}\n");
        for row in &bench.rows {
            writeln!(page, "{row}").map_err(|error| error.to_string())?;
        }
        let written = output::write(path, page.as_bytes());
        written.map_err(|error| format!("{}: {error}", path.display()))?;
    }
    Ok(summary.passes())
}

fn main() -> ExitCode {
    let arguments: Arguments = match command::arguments("mutate") {
        Ok(arguments) => arguments,
        Err(code) => return code,
    };
    match run(&arguments) {
        Ok(passes) => ExitCode::from(u8::from(!passes)),
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(command::REFUSED)
        }
    }
}
