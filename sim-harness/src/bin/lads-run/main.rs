//! `lads-run`: drives a bundle's policy through the simulated environment that its contract names, and reports success rates and latency.
//!
//! Everything that can be wrong is looked at before the first episode: arguments, the place for the JSON, the bundle, its golden episode,
//! the instruction, the assets, and whether contract and environment fit. Any of it ends with one line on stderr and exit code 2; an
//! interrupt ends with exit code 130. Files are written only after the last episode, to a temporary file that is then renamed.
//! `--verify` runs a reference's episodes instead, and its verdict is the exit code: 0 equivalent, 1 different, 3 inconclusive.
#![forbid(unsafe_code)]

mod arguments;
mod end;
mod language;
mod program;
mod record;
mod recordings;
mod report;
mod sweep;
mod verify;
mod viewer;

use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use arguments::Arguments;
use end::{End, print, refused, unwritable};
use indicatif::ProgressBar;
use lads_compiler::Contract;
use lads_core::{Decision, Isa, Policy};
use lads_host::Memory;
use lads_sim::environment::Environment;
use lads_sim::evaluate::{Assignment, Evaluated, Evaluation, EvaluationError, Setup};
use lads_sim::faults::Faults;
use lads_sim::plans;
use lads_sim::results::{self, Results};
use lads_sim::rollout::Actor;
use lads_sim::table::Table;
use lads_sim::verify::reference::Reference;
use lads_sim::{assets, command, fit, output, registry};
use language::{Chosen, Heard};
use program::Program;

/// Exit code after an interrupt, as shells have it: 128 and the signal's number.
const INTERRUPTED: u8 = 130;

/// Episodes of each instruction where nothing is said.
const EPISODES: u32 = 2;

fn main() -> ExitCode {
    let arguments: Arguments = match command::arguments("lads-run") {
        Ok(arguments) => arguments,
        Err(code) => return code,
    };
    match run(&arguments) {
        Ok(code) => code,
        Err(End::Interrupted) => {
            eprintln!("interrupted: nothing was written");
            ExitCode::from(INTERRUPTED)
        }
        Err(End::Refused(line)) => command::refuse(line),
    }
}

fn run(arguments: &Arguments) -> Result<ExitCode, End> {
    let stop = stop_on_interrupt()?;
    let threads = check_numbers(arguments)?;
    let isa = program::isa(arguments.isa)?;
    check_outputs(arguments)?;
    let reference = verify::reference(arguments)?;

    let about = |wrong: &dyn Display| refused(format!("{}: {wrong}", arguments.model.display()));
    let program = Program::open(arguments)?;
    let (bundle, policy) = (program.bundle(), program.policy());
    let chosen = Chosen::of(arguments, bundle)?;
    let mut heard = language::hear(arguments, bundle, &policy, &chosen)?;
    self_test(&policy, isa).map_err(|wrong| about(&wrong))?;
    let files = &arguments.recordings;
    if let Some(log) = &files.replay {
        return recordings::replay(&policy, bundle, isa, log);
    }
    if let Some(log) = &files.encode {
        return recordings::encode(&policy, log, arguments.json.as_deref());
    }
    let book = files.plans.as_deref();
    let book = book.map(|path| recordings::plans(&policy, bundle, path));
    let book = book.transpose()?;

    let contract = bundle.contract();
    let id = contract.environment.id.as_str();
    let noise = noise(arguments, reference.as_ref(), id);
    let open = registry::load(id, noise, &assets::vendor_dir()).map_err(refused)?;
    let environment = open();
    let commanded = fit::check(contract, environment.as_ref()).map_err(|misfit| {
        about(&format_args!(
            "{misfit}; use a bundle made for this environment"
        ))
    })?;
    heard.words.sentence = chosen.sentence(arguments, environment.as_ref())?;
    let assignments: Vec<_> = (0..)
        .zip(commanded)
        .filter(|(instruction, _)| chosen.has(*instruction))
        .filter(|(instruction, _)| book.as_ref().is_none_or(|book| book.knows(*instruction)))
        .map(|(instruction, commanded)| Assignment {
            instruction,
            commanded,
            max_steps: environment.max_steps(contract.evaluated(instruction as usize).1),
        })
        .chain(
            heard
                .words
                .sentence
                .iter()
                .map(|sentence| sentence.assignment(contract, environment.as_ref())),
        )
        .collect();
    check_plans(arguments, book.as_ref(), &assignments, contract)?;
    let mut evaluation = Evaluation {
        policy,
        contract,
        assignments: &assignments,
        episodes: arguments.episodes.unwrap_or(EPISODES),
        seed: arguments.seed,
        decision: decision(&policy, arguments.sample),
        actor: actor(arguments),
        isa,
        threads,
        setup: Setup {
            faults: arguments.faults.faults(),
            plans: book.as_ref(),
            stop_where_refused: false,
            traced: traced(arguments),
            words: Some(&heard.words),
            onlooker: None,
        },
    };
    if let Some(reference) = reference {
        reference
            .check(&lads_sim::verify::subject(bundle, environment.as_ref()))
            .map_err(refused)?;
        verify::prepare(&mut evaluation, &reference, arguments.episodes)?;
        return verify::run(
            &evaluation,
            bundle,
            &reference,
            &open,
            &arguments.certificate,
            &stop,
        );
    }
    let recording = record::prepare(files, &evaluation, &open)?;
    let viewer = viewer::prepare(arguments, &evaluation, &open)?;
    // Before the policy moves anything.
    print(&heard.first)?;
    let bench = Bench {
        evaluation,
        open: &open,
        environment: environment.as_ref(),
        noise,
        heard: &heard,
        stop: &stop,
    };
    if arguments.faults.sweep {
        return bench.sweep(arguments.json.as_deref());
    }
    bench.rollouts(arguments, recording, viewer)
}

/// The level of the observation noise: what was asked for, else the reference's, else the environment's usual one.
fn noise<'a>(arguments: &'a Arguments, reference: Option<&'a Reference>, id: &str) -> &'a str {
    let asked = arguments.noise.as_deref();
    asked
        .or(reference.map(|reference| reference.noise.as_str()))
        .or(registry::default_noise(id))
        .unwrap_or("none")
}

fn actor(arguments: &Arguments) -> Actor {
    if arguments.uniform {
        Actor::Uniform
    } else {
        Actor::Policy
    }
}

/// How many episodes of each instruction keep their control steps.
fn traced(arguments: &Arguments) -> u32 {
    let files = &arguments.recordings;
    if files.log.is_some() || files.monitor || arguments.report.is_some() {
        u32::MAX
    } else if files.record.is_some() {
        files.record_episode.saturating_add(1)
    } else {
        0
    }
}

/// Everything that was checked, ready to run.
struct Bench<'b> {
    evaluation: Evaluation<'b>,
    open: &'b registry::Opener,
    environment: &'b dyn Environment,
    noise: &'b str,
    heard: &'b Heard<'b>,
    stop: &'b AtomicBool,
}

impl Bench<'_> {
    fn run(&self, setup: Setup<'_>, what: &str) -> Result<(Results, Evaluated), End> {
        let evaluation = Evaluation {
            setup,
            ..self.evaluation
        };
        let start = Instant::now();
        let evaluated = evaluate(&evaluation, self.open, self.stop, what)?;
        let wall = start.elapsed();
        let results = self.sum_up(&evaluation, &evaluated, wall);
        Ok((results, evaluated))
    }

    /// The same in a window; the episodes that were finished when it was closed.
    fn show(&self, viewer: viewer::Viewer) -> Result<(Results, Evaluated), End> {
        let start = Instant::now();
        let evaluated = viewer.evaluate(&self.evaluation, self.open, self.stop)?;
        let results = self.sum_up(&self.evaluation, &evaluated, start.elapsed());
        Ok((results, evaluated))
    }

    /// All that was measured, summed up.
    fn sum_up(
        &self,
        evaluation: &Evaluation<'_>,
        evaluated: &Evaluated,
        wall: Duration,
    ) -> Results {
        let (environment, watched) = (self.environment, self.environment.sub_tasks());
        let mut splits = results::split_names(evaluation.contract);
        let sentence = self.heard.words.sentence.as_ref();
        splits.extend(sentence.map(|sentence| sentence.asked().split.to_owned()));
        let of_each = evaluation.assignments.iter().zip(&evaluated.episodes);
        let instructions: Vec<_> = of_each
            .filter(|(_, episodes)| !episodes.is_empty())
            .filter_map(|(assignment, episodes)| {
                let known = evaluation.instruction(assignment.instruction)?;
                Some(results::of_instruction(&known, watched, episodes))
            })
            .collect();
        let threads = evaluation.threads.min(evaluation.len());
        Results {
            format: results::FORMAT,
            format_version: results::FORMAT_VERSION,
            environment: results::environment_used(environment, &splits),
            bundle_sha256: evaluation.policy.contract().bundle_sha256().to_owned(),
            image_sha256: lads_compiler::sha256(evaluation.policy.image()),
            seed: evaluation.seed,
            noise: self.noise.to_owned(),
            decision: results::decision_used(evaluation.decision, evaluation.actor),
            episodes_per_instruction: evaluation.episodes,
            heard_by: self.heard.by.clone(),
            faults: Some(evaluation.setup.faults).filter(|&faults| faults != Faults::default()),
            plans_commanded: evaluation.setup.plans.is_some(),
            plan_agreement: None,
            versions: results::versions(),
            splits: results::Splits::of(&splits, &instructions, watched),
            instructions,
            latency_us: results::LatencyByKind::of(&evaluated.timing),
            time: results::TimeUse::of(&evaluated.timing, wall, threads),
        }
    }

    /// The benchmark once for each level of each fault.
    fn sweep(&self, json: Option<&Path>) -> Result<ExitCode, End> {
        let sweep = sweep::sweep(|faults, what| {
            let setup = Setup {
                faults,
                stop_where_refused: true,
                ..self.evaluation.setup
            };
            let (results, evaluated) = self.run(setup, what)?;
            Ok((results, evaluated.refused_at))
        })?;
        if let Some(path) = json {
            output::write_json(&sweep, path).map_err(|error| unwritable("--json", path, &error))?;
        }
        print(&sweep.table())?;
        Ok(ExitCode::SUCCESS)
    }

    /// The benchmark, and all files about it that were asked for.
    fn rollouts(
        &self,
        arguments: &Arguments,
        recording: Option<record::Recording>,
        viewer: Option<viewer::Viewer>,
    ) -> Result<ExitCode, End> {
        let (files, policy) = (&arguments.recordings, &self.evaluation.policy);
        let (mut results, evaluated) = match viewer {
            None => self.run(self.evaluation.setup, "")?,
            Some(viewer) => self.show(viewer)?,
        };
        if evaluated.episodes.iter().all(Vec::is_empty) {
            print(&"the window was closed before an episode ended: no results\n")?;
            return Ok(ExitCode::SUCCESS);
        }
        if files.monitor {
            let agreement = plans::agreement(policy, &evaluated.traces);
            results.plan_agreement = Some(
                agreement.map_err(|error| refused(format!("--monitor: {error}; leave it out")))?,
            );
        }
        // Filming takes time and may be interrupted: nothing is written before.
        let film = recording.map(|it| it.film(&self.evaluation, &evaluated.traces, self.stop));
        let film = film.transpose()?;
        let page = arguments.report.as_deref().map(|path| {
            let traces = &evaluated.traces;
            let about = (self.stop, path);
            let page = report::page(&results, traces, &self.evaluation, self.open, about);
            page.map(|page| (page, path))
        });
        let page = page.transpose()?;
        if let Some(film) = film {
            film.write()?;
        }
        if let Some(path) = &arguments.json {
            output::write_json(&results, path)
                .map_err(|error| unwritable("--json", path, &error))?;
        }
        if let Some(path) = &files.log {
            recordings::log(
                &self.evaluation,
                self.environment,
                self.noise,
                &evaluated.traces,
                path,
            )?;
        }
        if let Some((page, path)) = page {
            report::write(&page, path)?;
        }
        print(&Table(&results))?;
        print(&self.heard.last(&results))?;
        if let Some(agreement) = &results.plan_agreement {
            print(&recordings::agreement(agreement))?;
        }
        Ok(ExitCode::SUCCESS)
    }
}

/// Refuses plans that leave an episode without any.
fn check_plans(
    arguments: &Arguments,
    book: Option<&plans::PlanBook>,
    assignments: &[Assignment],
    contract: &Contract,
) -> Result<(), End> {
    let Some(book) = book else {
        return Ok(());
    };
    let name = |assignment: &Assignment| {
        let known = contract.instructions.get(assignment.instruction as usize);
        known.map_or_else(String::new, |known| known.id.clone())
    };
    if assignments.is_empty() {
        return Err(refused(
            "--plans: the file has no plans for the instructions asked for; leave --instruction out",
        ));
    }
    for assignment in assignments {
        let missing = (0..arguments.episodes.unwrap_or(EPISODES))
            .find(|&e| book.of(assignment.instruction, e).is_none());
        if let Some(episode) = missing {
            return Err(refused(format!(
                "--plans: the file has no plans for episode {episode} of {}; give fewer --episodes, or plans without an episode number",
                name(assignment)
            )));
        }
    }
    Ok(())
}

/// A flag that an interrupt raises; a second interrupt ends the program at once.
fn stop_on_interrupt() -> Result<Arc<AtomicBool>, End> {
    let stop = Arc::new(AtomicBool::new(false));
    let raised = Arc::clone(&stop);
    let handler = move || {
        if raised.swap(true, Ordering::Relaxed) {
            std::process::exit(i32::from(INTERRUPTED));
        }
    };
    ctrlc::set_handler(handler).map_err(|error| {
        refused(format!(
            "interrupts cannot be handled ({error}); run it in another shell"
        ))
    })?;
    Ok(stop)
}

/// Whether all files could be written and none is what is read or another one, before any work.
fn check_outputs(arguments: &Arguments) -> Result<(), End> {
    let files = &arguments.recordings;
    report::check(arguments.report.as_deref())?;
    let reference = arguments.verify.as_ref();
    let reference = reference.map(|named| verify::file(arguments, named.as_deref()));
    let inputs = [
        ("--model", Some(&arguments.model)),
        ("--image", arguments.image.as_ref()),
        ("--verify", reference.as_ref()),
        ("--replay", files.replay.as_ref()),
        ("--encode", files.encode.as_ref()),
        ("--plans", files.plans.as_ref()),
    ];
    let outputs = [
        ("--json", arguments.json.as_ref()),
        ("--report", arguments.report.as_ref()),
        ("--log", files.log.as_ref()),
    ];
    let certificates = arguments.certificate.iter();
    let certificates = certificates.map(|path| ("--certificate", Some(path)));
    let outputs = given(outputs.into_iter().chain(certificates));
    let film = given([("--record", files.record.as_ref())]);
    output::apart(&given(inputs), &[&outputs[..], &film].concat()).map_err(refused)?;
    output::check(&[], &outputs).map_err(refused)?;
    record::check(files)?;
    viewer::check(arguments)
}

/// The files that were named.
fn given<'p>(
    files: impl IntoIterator<Item = (&'p str, Option<&'p PathBuf>)>,
) -> Vec<output::Named<'p>> {
    let files = files.into_iter();
    files
        .filter_map(|(option, path)| Some((option, path?.as_path())))
        .collect()
}

/// Checks what needs no file; returns the number of threads.
fn check_numbers(arguments: &Arguments) -> Result<usize, End> {
    arguments.faults.faults().check().map_err(refused)?;
    if arguments.episodes == Some(0) {
        return Err(refused("--episodes 0: nothing to run; give at least 1"));
    }
    match arguments.threads {
        Some(0) => Err(refused(
            "--threads 0: nobody to run the episodes; give at least 1",
        )),
        Some(threads) if threads > 1 && arguments.viewer => Err(refused(format!(
            "--viewer --threads {threads}: a window shows one episode at a time; leave --threads out"
        ))),
        Some(threads) => Ok(threads),
        None if arguments.viewer => Ok(1),
        None => Ok(std::thread::available_parallelism().map_or(1, usize::from)),
    }
}

/// Replays the bundle's golden episode on the instructions that the policy is to run on; a policy that answers differently is not run.
fn self_test(policy: &Policy<'_>, isa: Isa) -> Result<(), String> {
    let mut memory = Memory::of(policy).map_err(|error| error.to_string())?;
    let mut controller = memory
        .controller_with(policy, isa)
        .map_err(|error| error.to_string())?;
    match controller.self_test() {
        Ok(_) => Ok(()),
        Err(error) => Err(format!(
            "the self-test failed: {error}; export the bundle again"
        )),
    }
}

/// The contract's rule; where sampling was asked for, at the contract's temperature, or at 1 where its rule is argmax.
fn decision(policy: &Policy<'_>, sample: bool) -> Decision {
    match policy.contract().decision() {
        Decision::Argmax if sample => Decision::Sample {
            temperature: 1.0,
            seed: 0,
        },
        rule => rule,
    }
}

/// A progress bar over episodes; indicatif hides it where stderr is no terminal.
fn progress(episodes: usize) -> ProgressBar {
    progress_over(episodes, "episodes")
}

/// A progress bar over other things.
fn progress_over(count: usize, things: &str) -> ProgressBar {
    command::progress(count, things)
}

/// Runs all episodes behind a progress bar, until `stop` is raised.
fn evaluate(
    evaluation: &Evaluation<'_>,
    open: &registry::Opener,
    stop: &AtomicBool,
    what: &str,
) -> Result<Evaluated, End> {
    let bar = progress(evaluation.len());
    bar.set_message(what.to_owned());
    let evaluated = evaluation.run(open, stop, &|| bar.inc(1));
    bar.finish_and_clear();
    evaluated.map_err(unfinished)
}

fn unfinished(error: EvaluationError) -> End {
    match error {
        EvaluationError::Interrupted => End::Interrupted,
        error => refused(format!(
            "{error}; run this instruction alone with the same seed to look into it"
        )),
    }
}
