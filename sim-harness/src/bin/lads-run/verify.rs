//! The `verify` subcommand: runs the reference's episodes, writes the certificate, and gives the verdict as exit code.

use std::ffi::OsStr;
use std::fmt;
use std::process::ExitCode;
use std::sync::atomic::AtomicBool;

use askama::Template as _;
use lads_proof::answers::Answers;
use lads_proof::frames::Frames;
use lads_proof::pairs::Paired;
use lads_proof::rounding::Rounding;
use lads_sim::faults::Faults;
use lads_sim::output;
use lads_sim::results::versions;
use lads_sim::rollout::Pictures;
use lads_sim::verify::certificate::Certificate;
use lads_sim::verify::page::Page;
use lads_sim::verify::reference::Reference;

use crate::arguments::{LanguageArguments, Verify, Wanted, reference};
use crate::bench;
use crate::end::{End, print, refused, unmade, unwritable};
use crate::{given, progress, some_episodes, threads, unfinished};

/// Runs the verification, writes and prints the certificate; gives the exit code.
pub fn run(asked: &Verify, stop: &AtomicBool) -> Result<ExitCode, End> {
    some_episodes(asked.episodes)?;
    let threads = threads(asked.threads, false)?;
    let file = reference(asked.reference.as_deref(), &asked.policy.model);
    let inputs = [
        ("--model", Some(&asked.policy.model)),
        ("--image", asked.policy.image.as_ref()),
        ("--reference", Some(&file)),
    ];
    let certificates = asked.certificate.iter();
    let outputs = given(certificates.map(|path| ("--certificate", Some(path))));
    output::apart(&given(inputs), &outputs).map_err(refused)?;
    output::check(&[], &outputs).map_err(refused)?;
    let reference = Reference::open(&file).map_err(unmade)?;
    let most = reference.episodes_per_instruction;
    let episodes = asked.episodes.unwrap_or(most);
    if episodes > most {
        return Err(refused(format!(
            "--episodes {episodes}: the reference has {most} of each instruction; give at most that, or make a larger one: make reference"
        )));
    }
    // The decision is by the contract's own rule, whatever the reference's was: the certificate compares the two.
    let wanted = Wanted {
        policy: &asked.policy,
        language: &LanguageArguments::default(),
        instruction: asked.instruction.as_deref(),
        episodes,
        seed: reference.seed,
        noise: Some(&reference.noise),
        sample: false,
        uniform: false,
        faults: Faults::default(),
        plans: None,
        traced: reference.traced_episodes.min(episodes),
        pictures: Pictures::None,
        threads,
        of_table: Some("verify"),
        judged: false,
    };
    bench::with(&wanted, stop, |bench| {
        let subject = lads_sim::verify::subject(bench.bundle, bench.environment);
        reference.check(&subject).map_err(refused)?;
        let bar = progress(lads_sim::verify::work(&bench.evaluation));
        let certificate = lads_sim::verify::run(
            &bench.evaluation,
            bench.bundle,
            &reference,
            bench.open,
            versions(),
            stop,
            &|| {
                bar.inc(1);
            },
        );
        bar.finish_and_clear();
        let certificate = certificate.map_err(unfinished)?;
        for path in &asked.certificate {
            let written = if path.extension() == Some(OsStr::new("html")) {
                let page = Page::new(&certificate).render().map_err(refused)?;
                output::write(path, page.as_bytes())
            } else {
                output::write_json(&certificate, path)
            };
            written.map_err(|error| unwritable("--certificate", path, &error))?;
        }
        print(&Summary(&certificate))?;
        Ok(ExitCode::from(certificate.verdict.exit_code()))
    })
}

/// Prints the summary of a policy's answers to the reference's questions.
fn alone(f: &mut fmt::Formatter<'_>, which: &str, answers: &Answers) -> fmt::Result {
    let allowed = answers.logit_tolerance.map_or(String::new(), |tolerance| {
        format!(" (allowed {tolerance:.1e})")
    });
    let plans = match answers.compared_plan_vectors {
        0 => String::new(),
        steps => format!(
            ", plans within {:.1e} (allowed {:.1e}) over {steps} steps",
            answers.largest_plan_difference, answers.plan_tolerance
        ),
    };
    writeln!(
        f,
        "{which:<18} {} of {} replayed episodes differ; logits within {:.1e}{allowed} over {} decisions{plans}, actions within {:.1e} (allowed {:.1e}) \
         over {} steps",
        answers.differing_episodes,
        answers.episodes,
        answers.largest_logit_difference,
        answers.compared_decisions,
        answers.largest_action_difference,
        answers.action_tolerance,
        answers.compared_steps
    )
}

/// Prints the summary of how fewer bits change the answers.
fn fewer_bits(f: &mut fmt::Formatter<'_>, rounding: &Rounding) -> fmt::Result {
    let judged = rounding
        .loss
        .as_ref()
        .map_or_else(|| "the same".to_owned(), ToString::to_string);
    writeln!(
        f,
        "  fewer bits       {judged}; logits moved by {:.1e} at most, {:.1} % of {} decisions clear by {} times that",
        rounding.largest_logit_difference,
        100.0 * rounding.clear_share,
        rounding.decisions,
        rounding.margin_factor
    )
}

/// Prints the summary of what the cameras show.
fn cameras(f: &mut fmt::Formatter<'_>, frames: &Frames) -> fmt::Result {
    writeln!(
        f,
        "frames             {} of {} are other bytes than the reference's; {} questions left out",
        frames.differing, frames.steps, frames.left_out
    )
}

/// Prints the table of rates: those of the run beside the reference's.
fn rates(f: &mut fmt::Formatter<'_>, rollouts: &Paired) -> fmt::Result {
    writeln!(
        f,
        "{:<16} {:>7} {:>9}   {:>25}   {:>10} {:>11}",
        "rate", "run", "reference", "paired difference (95 %)", "equivalent", "McNemar's p"
    )?;
    let n_rate = &rollouts.n_rate;
    let rates = rollouts.rates.iter().map(|rate| {
        let [run, reference] = rate.shares();
        (
            rate.name.as_str(),
            run,
            reference,
            &rate.paired,
            Some(rate.mcnemar_p),
        )
    });
    for (name, run, reference, paired, p) in
        rates.chain([("N-rate", n_rate.run, n_rate.reference, &n_rate.paired, None)])
    {
        let interval = format!(
            "{:+.3} ({:+.3} to {:+.3})",
            paired.estimate, paired.interval.0, paired.interval.1
        );
        let equivalent = if paired.equivalent { "yes" } else { "no" };
        let p = p.map_or_else(String::new, |p| format!("{p:.3}"));
        writeln!(
            f,
            "{name:<16} {run:>7.3} {reference:>9.3}   {interval:>25}   {equivalent:>10} {p:>11}"
        )?;
    }
    Ok(())
}

/// Prints the certificate on a terminal.
struct Summary<'c>(&'c Certificate);

impl fmt::Display for Summary<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Certificate {
            contract,
            policy,
            exact,
            rounding,
            environment,
            frames,
            rollouts,
            ..
        } = self.0;
        let differing = contract.differing.len() + contract.image_differing.len();
        writeln!(
            f,
            "contract           {} fields compared, {differing} values differ",
            contract.fields.len()
        )?;
        alone(f, "policy alone", policy)?;
        if let Some(exact) = exact {
            alone(f, "  with 32 bits", exact)?;
        }
        if let Some(rounding) = rounding {
            fewer_bits(f, rounding)?;
        }
        let bits = if environment.identical_bits {
            ", the same bits"
        } else {
            ""
        };
        writeln!(
            f,
            "environment alone  states within {:.1e} (allowed {:.1e}) over {} states{bits}",
            environment.largest_state_difference, environment.state_tolerance, environment.states
        )?;
        if let Some(frames) = frames {
            cameras(f, frames)?;
        }
        writeln!(
            f,
            "both together      {} pairs of episodes: completions identical in {:.1} %, plans in {:.1} %, steps in {:.1} %; actions within {:.1e} \
             while trajectories agree ({} of {} traced steps)\n",
            rollouts.episodes,
            100.0 * rollouts.identical_completions,
            100.0 * rollouts.identical_plans,
            100.0 * rollouts.identical_steps,
            rollouts.largest_action_difference,
            rollouts.agreeing_steps[0],
            rollouts.agreeing_steps[1]
        )?;
        rates(f, rollouts)?;
        writeln!(f, "\n{}", self.0.verdict.word())?;
        for reason in &self.0.reasons {
            writeln!(f, "- {reason}")?;
        }
        for note in &self.0.notes {
            writeln!(f, "- note: {note}")?;
        }
        let reference = &self.0.reference;
        writeln!(
            f,
            "- reference: weights from {}, words from {}",
            reference.weights_from, reference.words_from
        )?;
        writeln!(f, "- not covered: {}", self.0.not_covered.join("; "))?;
        match self.0.more_episodes_per_instruction {
            Some(more) => writeln!(
                f,
                "- about {more} more episodes of each instruction would decide, at these rates"
            ),
            None => Ok(()),
        }
    }
}
