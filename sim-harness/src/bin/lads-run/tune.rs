//! The `tune` subcommand: finds the smallest formats that keep every plan of a reference's questions, and writes them into the bundle.

use std::fmt;
use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::AtomicBool;

use indicatif::ProgressBar;
use lads_compiler::{Evidence, Tuned as Record, sha256};
use lads_host::input;
use lads_proof::rounding::Rounding;
use lads_sim::faults::Faults;
use lads_sim::output;
use lads_sim::rollout::Pictures;
use lads_sim::tune::{TuneError, Tuned, Tuning};
use lads_sim::verify::reference::{Reference, ReferenceError};
use lads_sim::verify::shown::Shown;

use crate::arguments::{LanguageArguments, PolicyArguments, Tune, Wanted};
use crate::bench::{self, Bench};
use crate::end::{End, print, refused, unmade, unwritable};
use crate::{given, unfinished};

/// Tunes, prints what was chosen and why, and writes the bundle.
pub fn run(asked: &Tune, stop: &AtomicBool) -> Result<ExitCode, End> {
    let model = &asked.model;
    let file = crate::arguments::reference(asked.reference.as_deref(), model);
    let inputs = [("--model", Some(model)), ("--reference", Some(&file))];
    let outputs = given([("-o", asked.output.as_ref())]);
    output::apart(&given(inputs), &outputs).map_err(refused)?;
    // Without -o it is the bundle itself that is written.
    let target = asked.output.as_ref().unwrap_or(model);
    output::check(&[], &[("-o", target)]).map_err(refused)?;
    let bytes = input::read(model)
        .map_err(|error| refused(format_args!("{}: {error}", model.display())))?;
    let questions = input::read(&file).map_err(|source| {
        unmade(ReferenceError::File {
            path: file.clone(),
            source,
        })
    })?;
    let reference = Reference::read(&questions, &file).map_err(unmade)?;
    let policy = PolicyArguments {
        model: model.clone(),
        image: None,
        isa: asked.isa,
        exact: true,
    };
    let wanted = Wanted {
        policy: &policy,
        language: &LanguageArguments::default(),
        instruction: None,
        episodes: reference.traced_episodes,
        seed: reference.seed,
        noise: Some(&reference.noise),
        sample: false,
        uniform: false,
        faults: Faults::default(),
        plans: None,
        traced: reference.traced_episodes,
        pictures: Pictures::None,
        threads: 1,
        of_table: Some("tune"),
        judged: false,
    };
    let tuned = bench::with(&wanted, stop, |bench| {
        let subject = lads_sim::verify::subject(bench.bundle, bench.environment);
        reference.check(&subject).map_err(refused)?;
        if bench.bundle.sha256() != sha256(&bytes) {
            return Err(refused(format_args!(
                "{}: it changed while it was read; start again",
                model.display()
            )));
        }
        let evaluation = &bench.evaluation;
        let shown = shown(bench, &reference, model, stop)?;
        let tuning = Tuning {
            bundle: bench.bundle,
            reference: &reference,
            assignments: evaluation.assignments,
            shown: shown.as_ref(),
            isa: bench.evaluation.isa,
        };
        let bar = ProgressBar::new_spinner();
        let tuned = tuning.run(stop, &mut |storage| {
            bar.inc(1);
            bar.set_message(format!("candidate {}: {storage}", bar.position()));
        });
        bar.finish_and_clear();
        tuned.map_err(|error| match error {
            TuneError::Asking(error) => unfinished(error),
            error => refused(format_args!("{}: {error}", model.display())),
        })
    })?;
    let evidence = evidence(&tuned.found.judged, &questions);
    let record = Record::new(tuned.found.storage.clone(), evidence);
    let written = record.written_into(&bytes).map_err(refused)?;
    output::write(target, &written).map_err(|error| unwritable("-o", target, &error))?;
    print(&Summary(&tuned))?;
    print(&format_args!(
        "{}: sha256 {}\n",
        target.display(),
        sha256(&written)
    ))?;
    Ok(ExitCode::SUCCESS)
}

/// Collects what the bundle keeps of the search: the numbers that its choice rests on.
fn evidence(seen: &Rounding, questions: &[u8]) -> Evidence {
    Evidence {
        reference_sha256: sha256(questions),
        episodes: seen.episodes,
        steps: seen.steps,
        decisions: seen.decisions,
        smallest_margin: seen.smallest_margin,
        largest_logit_error: seen.largest_logit_difference,
        segments: seen.segments,
        clear_share: seen.clear_share,
        margin_factor: seen.margin_factor,
        largest_action_error: seen.largest_action_difference,
        action_tolerance: seen.action_tolerance,
    }
}

/// Draws what the cameras show in the reference's episodes, which has to be what they showed it.
fn shown(
    bench: &Bench<'_>,
    reference: &Reference,
    model: &Path,
    stop: &AtomicBool,
) -> Result<Option<Shown>, End> {
    let evaluation = &bench.evaluation;
    let shown = Shown::draw(
        (evaluation.contract, &evaluation.policy),
        bench.environment,
        (reference, evaluation.assignments, reference.traced_episodes),
        stop,
    );
    let shown = shown.map_err(unfinished)?;
    let unlike = shown.as_ref().and_then(|it| it.compared.undecided());
    match unlike {
        Some(why) => Err(refused(format_args!("{}: {why}", model.display()))),
        None => Ok(shown),
    }
}

/// Prints the chosen formats on a terminal.
struct Summary<'t>(&'t Tuned);

impl fmt::Display for Summary<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Tuned { found, images } = self.0;
        for choice in &found.choices {
            writeln!(f, "{:<28} {}", choice.part, choice.stored)?;
            for (format, why) in &choice.refused {
                writeln!(f, "{:<28}   not {format}: {why}", "")?;
            }
        }
        let seen = &found.judged;
        writeln!(
            f,
            "\nthe same plans in {} decisions and {} steps of {} episodes",
            seen.decisions, seen.steps, seen.episodes
        )?;
        if let Some(margin) = seen.smallest_margin {
            writeln!(
                f,
                "logits within {:.1e}, smallest margin {margin:.1e}; {:.1} % of the decisions are clear by {} times the logits' difference",
                seen.largest_logit_difference,
                100.0 * seen.clear_share,
                seen.margin_factor
            )?;
        }
        writeln!(
            f,
            "actions within {:.1e}, allowed {:.1e}",
            seen.largest_action_difference, seen.action_tolerance
        )?;
        let [exact, image] = images.each_ref().map(|image| image.as_bytes().len());
        writeln!(f, "image {image} bytes, with 32 bits {exact}")
    }
}
