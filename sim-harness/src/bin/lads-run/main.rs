//! `lads-run`: drives a bundle's policy through the simulated environment that its contract names, and reports success rates and latency.
//!
//! Everything that can be wrong is looked at before the first episode: arguments, the place for the JSON, the bundle, its golden episode,
//! the instruction, the assets, and whether contract and environment fit. Any of it ends with one line on stderr and exit code 2; an
//! interrupt ends with exit code 130. Files are written only after the last episode, to a temporary file that is then renamed.
//! `--verify` runs a reference's episodes instead, and its verdict is the exit code: 0 equivalent, 1 different, 3 inconclusive.
#![forbid(unsafe_code)]

mod verify;

use std::collections::BTreeMap;
use std::fmt::Display;
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use lads_compiler::{Bundle, Memory, compile};
use lads_core::{Decision, Isa, Policy};
use lads_sim::environment::Environment;
use lads_sim::evaluate::{Assignment, Evaluated, Evaluation, EvaluationError};
use lads_sim::results::{self, DecisionUsed, EnvironmentUsed, InstructionResult, Results};
use lads_sim::rollout::Actor;
use lads_sim::table::Table;
use lads_sim::{assets, command, fit, output, registry};

/// Exit code after an interrupt, as shells have it: 128 and the signal's number.
const INTERRUPTED: u8 = 130;

/// Runs a policy bundle in simulation over its instructions; prints success rates and control-step latency.
#[derive(Debug, Parser)]
#[command(version)]
struct Arguments {
    /// The policy bundle (ONNX)
    #[arg(long)]
    model: PathBuf,
    /// Run only this instruction, by its text or its id
    #[arg(long)]
    instruction: Option<String>,
    /// Episodes of each instruction; left out, 2, and with --verify all that the reference has
    #[arg(long)]
    episodes: Option<u32>,
    /// Seed of all random streams; the same seed gives the same episodes on any number of threads
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Observation noise: in the kitchen v0 (D4RL's, the default), v1 (Gymnasium-Robotics') or none
    #[arg(long)]
    noise: Option<String>,
    /// Threads; left out, one per core
    #[arg(long)]
    threads: Option<usize>,
    /// Sample plans from the policy's distribution instead of taking the likeliest
    #[arg(long)]
    sample: bool,
    /// Draw uniform random actions instead of asking the policy: the floor that it is measured against
    #[arg(long, conflicts_with = "sample")]
    uniform: bool,
    /// Write the results to this file as JSON (its form: sim-harness/results.schema.json)
    #[arg(long)]
    json: Option<PathBuf>,
    /// Instructions that the kernels run on; left out, the widest of this CPU. The results have the same bits on all
    #[arg(long)]
    isa: Option<IsaName>,
    /// Run the episodes of a reference and say whether the policy is the reference's: exit code 0 EQUIVALENT, 1 DIFFERENT, 3 INCONCLUSIVE.
    /// Left out, REFERENCE is the file beside the model that ends in .reference.json
    #[arg(long, value_name = "REFERENCE", num_args = 0..=1, conflicts_with_all = ["seed", "noise", "sample", "uniform", "json"])]
    #[expect(
        clippy::option_option,
        reason = "clap's form of an option whose value may be left out"
    )]
    verify: Option<Option<PathBuf>>,
    /// Write the certificate of --verify to this file, as JSON (its form: sim-harness/certificate.schema.json) or, where it ends in .html, as
    /// a page; may be given twice
    #[arg(long, requires = "verify")]
    certificate: Vec<PathBuf>,
}

/// Instruction sets by name.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum IsaName {
    Portable,
    Avx2,
    Avx512,
}

/// How a run ends early.
enum End {
    /// With a line that names the thing and the remedy.
    Refused(String),
    /// By an interrupt.
    Interrupted,
}

fn refused(line: impl Display) -> End {
    End::Refused(line.to_string())
}

fn main() -> ExitCode {
    let arguments = match command::arguments("lads-run") {
        Ok(arguments) => arguments,
        Err(code) => return code,
    };
    match run(&arguments) {
        Ok(code) => ExitCode::from(code),
        Err(End::Interrupted) => {
            eprintln!("interrupted: nothing was written");
            ExitCode::from(INTERRUPTED)
        }
        Err(End::Refused(line)) => command::refuse(line),
    }
}

fn run(arguments: &Arguments) -> Result<u8, End> {
    let stop = stop_on_interrupt()?;
    let threads = check_numbers(arguments)?;
    let isa = isa(arguments.isa)?;
    for (option, path) in outputs(arguments) {
        drop(output::temporary_beside(path).map_err(|error| unwritable(option, path, &error))?);
    }
    let reference = verify::reference(arguments)?;

    let about = |wrong: &dyn Display| refused(format!("{}: {wrong}", arguments.model.display()));
    let bundle = Bundle::open(&arguments.model).map_err(refused)?;
    let image = compile(&bundle).map_err(|error| about(&error))?;
    let policy = Policy::new_checked(image.as_bytes())
        .map_err(|error| about(&format_args!("{error}; export the bundle again")))?;
    let chosen = choose(&bundle, arguments.instruction.as_deref())?;
    self_test(&policy).map_err(|wrong| about(&wrong))?;

    let contract = policy.contract();
    let id = contract.environment_id();
    let noise = arguments.noise.as_deref();
    let noise = noise.or(reference.as_ref().map(|reference| reference.noise.as_str()));
    let noise = noise.unwrap_or_else(|| registry::default_noise(id).unwrap_or("none"));
    let open = registry::load(id, noise, &assets::vendor_dir()).map_err(refused)?;
    let environment = open();
    let commanded = fit::check(&contract, environment.as_ref()).map_err(|misfit| {
        about(&format_args!(
            "{misfit}; use a bundle made for this environment"
        ))
    })?;
    let assignments: Vec<_> = (0..)
        .zip(contract.instructions().zip(commanded))
        .filter(|(instruction, _)| chosen.as_ref().is_none_or(|all| all.contains(instruction)))
        .map(|(instruction, (known, commanded))| Assignment {
            instruction,
            commanded,
            max_steps: environment.max_steps(known.split),
        })
        .collect();
    let mut evaluation = Evaluation {
        policy,
        assignments: &assignments,
        episodes: arguments.episodes.unwrap_or(2),
        seed: arguments.seed,
        decision: decision(&policy, arguments.sample),
        actor: if arguments.uniform {
            Actor::Uniform
        } else {
            Actor::Policy
        },
        isa,
        traced: 0,
        threads,
    };
    if let Some(reference) = reference {
        reference
            .check(&bundle, environment.as_ref())
            .map_err(refused)?;
        verify::prepare(&mut evaluation, &reference, arguments.episodes)?;
        return verify::run(
            &evaluation,
            &reference,
            &open,
            &arguments.certificate,
            &stop,
        );
    }
    let start = Instant::now();
    let evaluated = evaluate(&evaluation, &open, &stop)?;
    let wall = start.elapsed();

    let results = report(&evaluation, environment.as_ref(), noise, &evaluated, wall);
    if let Some(path) = &arguments.json {
        output::write_json(&results, path).map_err(|error| unwritable("--json", path, &error))?;
    }
    print(&Table(&results))?;
    Ok(0)
}

/// The files that will be written, with the options that name them.
fn outputs(arguments: &Arguments) -> impl Iterator<Item = (&'static str, &PathBuf)> {
    let json = arguments.json.iter().map(|path| ("--json", path));
    json.chain(
        arguments
            .certificate
            .iter()
            .map(|path| ("--certificate", path)),
    )
}

/// The instructions that were asked for, if this CPU has them.
fn isa(name: Option<IsaName>) -> Result<Isa, End> {
    let Some(name) = name else {
        return Ok(Isa::detect());
    };
    let name = format!("{name:?}").to_lowercase();
    Isa::all().find(|isa| isa.name() == name).ok_or_else(|| {
        let offered: Vec<_> = Isa::all().map(Isa::name).collect();
        refused(format!(
            "--isa {name}: this CPU does not have it; it has {}",
            offered.join(", ")
        ))
    })
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

/// Checks what needs no file; returns the number of threads.
fn check_numbers(arguments: &Arguments) -> Result<usize, End> {
    if arguments.episodes == Some(0) {
        return Err(refused("--episodes 0: nothing to run; give at least 1"));
    }
    match arguments.threads {
        Some(0) => Err(refused(
            "--threads 0: nobody to run the episodes; give at least 1",
        )),
        Some(threads) => Ok(threads),
        None => Ok(std::thread::available_parallelism().map_or(1, usize::from)),
    }
}

fn unwritable(option: &str, path: &Path, error: &std::io::Error) -> End {
    refused(format!(
        "{option} {}: cannot be written ({error}); name a file in an existing, writable folder",
        path.display()
    ))
}

/// The numbers of the instructions with the id or the text that was asked for; `None` for all.
fn choose(bundle: &Bundle, instruction: Option<&str>) -> Result<Option<Vec<u32>>, End> {
    let Some(wanted) = instruction else {
        return Ok(None);
    };
    let found = bundle.instruction_indices(wanted);
    if !found.is_empty() {
        return Ok(Some(found.into_iter().map(|index| index as u32).collect()));
    }
    let nearest = bundle
        .nearest_instructions(wanted)
        .iter()
        .map(|text| format!("'{text}'"))
        .collect::<Vec<_>>();
    Err(refused(format!(
        "--instruction '{wanted}': the bundle does not know it; the nearest that it knows: {}",
        nearest.join(", ")
    )))
}

/// Replays the bundle's golden episode on this machine; a policy that answers differently is not run.
fn self_test(policy: &Policy<'_>) -> Result<(), String> {
    let mut memory = Memory::of(policy);
    let mut controller = memory
        .controller(policy)
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

/// Runs all episodes behind a progress bar, until `stop` is raised.
fn evaluate(
    evaluation: &Evaluation<'_>,
    open: &registry::Opener,
    stop: &AtomicBool,
) -> Result<Evaluated, End> {
    let bar = progress(evaluation);
    let evaluated = evaluation.run(open, stop, &|| bar.inc(1));
    bar.finish_and_clear();
    evaluated.map_err(unfinished)
}

/// A bar over all episodes; hidden by indicatif where stderr is no terminal.
fn progress(evaluation: &Evaluation<'_>) -> ProgressBar {
    let bar = ProgressBar::new(evaluation.len() as u64);
    let style = ProgressStyle::with_template(
        "{bar:40} {pos}/{len} episodes, {elapsed} elapsed, {eta} left",
    );
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar.enable_steady_tick(Duration::from_millis(200));
    bar
}

fn unfinished(error: EvaluationError) -> End {
    match error {
        EvaluationError::Interrupted => End::Interrupted,
        error => refused(format!(
            "{error}; run this instruction alone with the same seed to look into it"
        )),
    }
}

fn report(
    evaluation: &Evaluation<'_>,
    environment: &dyn Environment,
    noise: &str,
    evaluated: &Evaluated,
    wall: Duration,
) -> Results {
    let (contract, watched) = (evaluation.policy.contract(), environment.sub_tasks());
    let splits = results::split_names(&contract);
    let of_each = evaluation.assignments.iter().zip(&evaluated.episodes);
    let instructions: Vec<_> = of_each
        .filter_map(|(assignment, episodes)| {
            let known = contract.instruction(assignment.instruction as usize)?;
            Some(InstructionResult::new(&known, watched, episodes))
        })
        .collect();
    let threads = evaluation.threads.min(evaluation.len());
    Results {
        format: results::FORMAT,
        format_version: results::FORMAT_VERSION,
        environment: EnvironmentUsed::new(environment, &splits),
        bundle_sha256: contract.bundle_sha256().to_owned(),
        seed: evaluation.seed,
        noise: noise.to_owned(),
        decision: DecisionUsed::of(evaluation.decision, evaluation.actor),
        episodes_per_instruction: evaluation.episodes,
        versions: versions(),
        splits: results::Splits::of(&splits, &instructions, watched),
        instructions,
        latency_us: results::LatencyByKind::of(&evaluated.timing),
        time: results::TimeUse::of(&evaluated.timing, wall, threads),
    }
}

/// What the numbers depend on besides the bundle.
fn versions() -> BTreeMap<&'static str, String> {
    BTreeMap::from([
        ("lads-sim", env!("CARGO_PKG_VERSION").to_owned()),
        ("mujoco", mujoco_rs::mujoco_version().to_owned()),
    ])
}

/// Prints to stdout; a reader that has left is no failure.
fn print(table: &dyn Display) -> Result<(), End> {
    let mut stdout = std::io::stdout().lock();
    match write!(stdout, "{table}").and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(refused(format!(
            "stdout: cannot be written ({error}); connect it to a place with room"
        ))),
        _ => Ok(()),
    }
}
