//! Collects demonstrations into one safetensors file (layout: [`lads_sim::dataset`]): scripted ones in the kitchen, labelled random
//! trajectories on the `LOReL` table.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Parser, ValueEnum};
use lads_sim::assets::vendor_dir;
use lads_sim::collect::{Settings, Tally, collect};
use lads_sim::dataset::Dataset;
use lads_sim::instructions::Instructions;
use lads_sim::kitchen::{Noise, Scene};
use lads_sim::{command, lorel, output};

/// Collects demonstrations: of the kitchen's seen instructions by scripted experts, of the `LOReL` table by random actions with post-hoc labels.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// The environment to collect in.
    #[arg(long, value_enum, default_value = "kitchen")]
    env: EnvironmentName,
    /// The dataset to write (safetensors); left out, data/ENV.safetensors.
    #[arg(short, long)]
    output: Option<PathBuf>,
    /// kitchen: successful demonstrations of each instruction (default 25).
    #[arg(long)]
    episodes_per_instruction: Option<usize>,
    /// lorel: trajectories to run, those that move nothing included (default 50000).
    #[arg(long)]
    episodes: Option<usize>,
    /// Seed of everything random; the same seed gives the same file.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// kitchen: noise of the observations: none, v0 (default) or v1.
    #[arg(long)]
    noise: Option<Noise>,
    /// kitchen: largest standard deviation of the recovery noise on executed actions; 0 for none (default 0.25).
    #[arg(long)]
    recovery_noise: Option<f64>,
    /// Worker threads; all cores if not given.
    #[arg(long)]
    threads: Option<NonZeroUsize>,
}

#[derive(Clone, Copy, ValueEnum)]
enum EnvironmentName {
    /// Franka Kitchen: 22 instructions of four sub-tasks.
    Kitchen,
    /// The `LOReL` table: a drawer, a faucet and two mugs.
    Lorel,
}

/// What to collect, in the terms of one environment.
enum Order {
    Kitchen(Settings),
    Lorel(lorel::collect::Settings),
}

impl Order {
    /// Turns the arguments into an order; refuses the options of the other environment.
    fn new(arguments: &Arguments) -> Result<Self, String> {
        let given = [
            (
                "--episodes-per-instruction",
                arguments.episodes_per_instruction.is_some(),
            ),
            ("--noise", arguments.noise.is_some()),
            ("--recovery-noise", arguments.recovery_noise.is_some()),
            ("--episodes", arguments.episodes.is_some()),
        ];
        let foreign = match arguments.env {
            EnvironmentName::Kitchen => &given[3..],
            EnvironmentName::Lorel => &given[..3],
        };
        if let Some((name, _)) = foreign.iter().find(|(_, is_given)| *is_given) {
            return Err(format!(
                "{name} means nothing in this environment; see lads-collect --help"
            ));
        }
        let threads = arguments
            .threads
            .or_else(|| std::thread::available_parallelism().ok())
            .unwrap_or(NonZeroUsize::MIN);
        Ok(match arguments.env {
            EnvironmentName::Kitchen => Self::Kitchen(Settings {
                episodes_per_instruction: arguments.episodes_per_instruction.unwrap_or(25),
                seed: arguments.seed,
                noise: arguments.noise.unwrap_or(Noise::V0),
                recovery_noise: arguments.recovery_noise.unwrap_or(0.25),
                threads,
            }),
            EnvironmentName::Lorel => Self::Lorel(lorel::collect::Settings {
                episodes: arguments.episodes.unwrap_or(50_000),
                seed: arguments.seed,
                threads,
            }),
        })
    }

    fn default_output(&self) -> PathBuf {
        PathBuf::from(match self {
            Self::Kitchen(_) => "data/kitchen.safetensors",
            Self::Lorel(_) => "data/lorel.safetensors",
        })
    }
}

fn main() -> ExitCode {
    let arguments = match command::arguments("lads-collect") {
        Ok(arguments) => arguments,
        Err(code) => return code,
    };
    match run(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => command::refuse(error),
    }
}

fn run(arguments: &Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let order = Order::new(arguments)?;
    let output = arguments.output.clone();
    let output = output.unwrap_or_else(|| order.default_output());
    // Looked at before minutes of work, not after.
    drop(output::draft_with_folder(&output).map_err(|error| {
        format!(
            "{}: cannot be written ({error}); name a file in a writable folder with -o",
            output.display()
        )
    })?);
    match order {
        Order::Kitchen(settings) => demonstrate(&settings, &output),
        Order::Lorel(settings) => wander(&settings, &output),
    }
}

/// Collects random trajectories of the `LOReL` table into `output`.
fn wander(
    settings: &lorel::collect::Settings,
    output: &Path,
) -> Result<(), Box<dyn std::error::Error>> {
    let scene = lorel::Scene::load(&vendor_dir())?;
    let bar = command::progress(settings.episodes, "trajectories");
    let collected = lorel::collect::collect(&scene, settings, |finished| {
        bar.inc(finished as u64);
    });
    bar.finish_and_clear();
    let collected = collected?;
    collected.write(output)?;
    let nothing = collected.nothing();
    println!(
        "{} trajectories in {}; {nothing} of {} moved nothing and were left out ({:.1} %)",
        collected.trajectories.len(),
        output.display(),
        collected.episodes,
        100.0 * nothing as f64 / collected.episodes as f64
    );
    Ok(())
}

/// Collects scripted demonstrations of the kitchen into `output`.
fn demonstrate(settings: &Settings, output: &Path) -> Result<(), Box<dyn std::error::Error>> {
    let scene = Scene::load(&vendor_dir())?;
    let instructions = Instructions::kitchen().seen;
    let total = instructions.len() * settings.episodes_per_instruction;
    let bar = command::progress(total, "episodes");
    let mut discarded = 0;
    let collected = collect(&scene, &instructions, settings, |success| {
        if success {
            bar.inc(1);
        } else {
            discarded += 1;
        }
        bar.set_message(format!("({discarded} failed)"));
    });
    bar.finish_and_clear();
    let (dataset, tallies) = collected?;
    dataset.write(output)?;
    print_summary(&dataset, &tallies, output);
    Ok(())
}

fn print_summary(dataset: &Dataset, tallies: &[Tally], output: &Path) {
    println!(
        "{:<12} {:>8} {:>9} {:>9} {:>11}",
        "instruction", "attempts", "successes", "rate", "mean steps"
    );
    let mut total = Tally::default();
    for (instruction, tally) in dataset.instructions.iter().zip(tallies) {
        print_row(&instruction.id, tally);
        total.attempts += tally.attempts;
        total.discarded += tally.discarded;
        total.steps += tally.steps;
    }
    print_row("all", &total);
    println!(
        "{} demonstrations, {} steps in {}",
        dataset.demonstrations.len(),
        dataset.steps(),
        output.display()
    );
}

fn print_row(name: &str, tally: &Tally) {
    let successes = tally.attempts - tally.discarded;
    let rate = 100.0 * successes as f64 / tally.attempts.max(1) as f64;
    let mean = tally.steps as f64 / successes.max(1) as f64;
    println!(
        "{name:<12} {:>8} {successes:>9} {rate:>8.1}% {mean:>11.1}",
        tally.attempts
    );
}
