//! Runs the benchmark, in a window or without, and writes all files that were asked for.

use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use lads_sim::evaluate::Evaluated;
use lads_sim::faults::FaultError;
use lads_sim::results::Results;
use lads_sim::rollout::Pictures;
use lads_sim::table::Table;
use lads_sim::{output, plans};

use crate::arguments::{Record, Rollouts, Wanted};
use crate::bench::{self, Bench};
use crate::end::{End, print, refused, unwritable};
use crate::{given, record, recordings, report, some_episodes, threads, viewer};

/// Options of single jobs beyond those of [`Rollouts`].
#[derive(Default)]
pub struct Extra<'e> {
    /// Whether actions are random instead of the policy's.
    pub uniform: bool,
    pub report: Option<&'e Path>,
    pub viewer: bool,
    pub record: Option<&'e Record>,
}

/// The option that a refused fault was given by.
fn option(error: FaultError) -> &'static str {
    match error {
        FaultError::Delay(_) => "--delay-steps",
        FaultError::Drop(_) => "--drop-rate",
        FaultError::Noise(_) => "--noise-scale",
        FaultError::Lag(_) => "--action-lag",
        _ => "the faults",
    }
}

/// Runs the episodes and writes their files.
pub fn run(asked: &Rollouts, extra: &Extra<'_>, stop: &AtomicBool) -> Result<ExitCode, End> {
    let (files, episodes) = (&asked.files, &asked.episodes);
    let faults = asked.faults.faults().check();
    faults.map_err(|error| refused(format!("{}: {error}", option(error))))?;
    some_episodes(Some(episodes.episodes))?;
    let threads = threads(episodes.threads, extra.viewer)?;
    check_outputs(asked, extra)?;
    let wanted = Wanted {
        uniform: extra.uniform,
        faults: asked.faults.faults(),
        plans: files.plans.as_deref(),
        traced: traced(asked, extra),
        pictures: match (&asked.files.log, extra.report) {
            (Some(_), _) => Pictures::All,
            (None, Some(_)) => Pictures::Decisions,
            (None, None) => Pictures::None,
        },
        of_table: match (&files.plans, extra.report) {
            (Some(_), _) => Some("--plans"),
            (None, Some(_)) => Some("--report"),
            (None, None) => None,
        },
        ..Wanted::of(&asked.policy, &asked.language, episodes, threads)
    };
    bench::with(&wanted, stop, |bench| {
        let recording = record::prepare(extra.record, &bench.evaluation, bench.open)?;
        let viewer = viewer::prepare(extra.viewer, &bench.evaluation, bench.open)?;
        // Before the policy moves anything.
        print(&bench.heard.first)?;
        rollouts(bench, asked, extra, recording, viewer)
    })
}

/// Number of episodes per instruction whose control steps are kept.
fn traced(asked: &Rollouts, extra: &Extra<'_>) -> u32 {
    if asked.files.log.is_some() || asked.files.monitor || extra.report.is_some() {
        return u32::MAX;
    }
    let filmed = extra.record;
    filmed.map_or(0, |record| record.episode.saturating_add(1))
}

/// Checks, before any work, that all output files can be written and that none is an input or named twice.
fn check_outputs(asked: &Rollouts, extra: &Extra<'_>) -> Result<(), End> {
    report::check(extra.report)?;
    let (policy, files) = (&asked.policy, &asked.files);
    let inputs = given([
        ("--model", Some(&policy.model)),
        ("--image", policy.image.as_ref()),
        ("--plans", files.plans.as_ref()),
    ]);
    let mut outputs = given([
        ("--json", files.json.as_ref()),
        ("--log", files.log.as_ref()),
    ]);
    outputs.extend(extra.report.map(|path| ("--report", path)));
    let film = given([("record", extra.record.map(|record| &record.out))]);
    output::apart(&inputs, &[&outputs[..], &film].concat()).map_err(refused)?;
    output::check(&[], &outputs).map_err(refused)?;
    record::check(extra.record)?;
    viewer::check(extra.viewer)
}

/// Runs the episodes in a window; returns the results of those that were finished when it was closed.
fn show(bench: &Bench<'_>, viewer: viewer::Viewer) -> Result<(Results, Evaluated), End> {
    let start = Instant::now();
    let evaluated = viewer.evaluate(&bench.evaluation, bench.open, bench.stop)?;
    let results = bench.sum_up(&bench.evaluation, &evaluated, start.elapsed());
    Ok((results, evaluated))
}

fn rollouts(
    bench: &Bench<'_>,
    asked: &Rollouts,
    extra: &Extra<'_>,
    recording: Option<record::Recording>,
    viewer: Option<viewer::Viewer>,
) -> Result<ExitCode, End> {
    let (files, evaluation) = (&asked.files, &bench.evaluation);
    let (mut results, evaluated) = match viewer {
        None => bench.run(evaluation.setup, "")?,
        Some(viewer) => show(bench, viewer)?,
    };
    if evaluated.episodes.iter().all(Vec::is_empty) {
        print(&"the window was closed before an episode ended: no results\n")?;
        return Ok(ExitCode::SUCCESS);
    }
    if files.monitor {
        let agreement = plans::agreement(&evaluation.policy, evaluation.isa, &evaluated.traces);
        results.plan_agreement =
            Some(agreement.map_err(|error| refused(format!("--monitor: {error}; leave it out")))?);
    }
    // Filming takes time and may be interrupted: nothing is written before.
    let film = recording.map(|it| it.film(evaluation, &evaluated.traces, bench.stop));
    let film = film.transpose()?;
    let page = extra.report.map(|path| {
        let about = (bench.stop, path);
        let page = report::page(&results, &evaluated.traces, evaluation, bench.open, about);
        page.map(|page| (page, path))
    });
    let page = page.transpose()?;
    if let Some(film) = film {
        film.write()?;
    }
    if let Some(path) = &files.json {
        output::write_json(&results, path).map_err(|error| unwritable("--json", path, &error))?;
    }
    if let Some(path) = &files.log {
        let (environment, noise) = (bench.environment, bench.noise);
        recordings::log(evaluation, environment, noise, &evaluated.traces, path)?;
    }
    if let Some((page, path)) = page {
        report::write(&page, path)?;
    }
    print(&Table(&results))?;
    print(&bench.heard.last(&results))?;
    if let Some(agreement) = &results.plan_agreement {
        print(&recordings::agreement(agreement))?;
    }
    Ok(ExitCode::SUCCESS)
}
