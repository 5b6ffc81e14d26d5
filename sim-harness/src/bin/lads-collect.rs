//! Collects scripted demonstrations into one safetensors file, see [`lads_sim::dataset`] for its layout.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::{Parser, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use lads_sim::assets::vendor_dir;
use lads_sim::collect::{Settings, Tally, collect};
use lads_sim::dataset::Dataset;
use lads_sim::instructions::Instructions;
use lads_sim::kitchen::{Noise, Scene};
use lads_sim::{command, output};

/// Collects scripted demonstrations of an environment's seen instructions.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// The environment.
    #[arg(long, value_enum, default_value = "kitchen")]
    env: EnvironmentName,
    /// The dataset to write (safetensors).
    #[arg(short, long, default_value = "data/kitchen.safetensors")]
    output: PathBuf,
    /// Successful demonstrations of each instruction.
    #[arg(long, default_value_t = 25)]
    episodes_per_instruction: usize,
    /// Seed of everything random; the same seed gives the same file.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Noise of the observations: none, v0 or v1.
    #[arg(long, default_value = "v0")]
    noise: Noise,
    /// Largest standard deviation of the recovery noise on executed actions; 0 for none.
    #[arg(long, default_value_t = 0.25)]
    recovery_noise: f64,
    /// Worker threads; all cores if not given.
    #[arg(long)]
    threads: Option<NonZeroUsize>,
}

#[derive(Clone, Copy, ValueEnum)]
enum EnvironmentName {
    /// Franka Kitchen: 22 instructions of four sub-tasks.
    Kitchen,
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
    let EnvironmentName::Kitchen = arguments.env;
    let settings = Settings {
        episodes_per_instruction: arguments.episodes_per_instruction,
        seed: arguments.seed,
        noise: arguments.noise,
        recovery_noise: arguments.recovery_noise,
        threads: arguments
            .threads
            .or_else(|| std::thread::available_parallelism().ok())
            .unwrap_or(NonZeroUsize::MIN),
    };
    // Looked at before minutes of work, not after.
    drop(
        output::temporary_with_folder(&arguments.output).map_err(|error| {
            format!(
                "{}: cannot be written ({error}); name a file in a writable folder with -o",
                arguments.output.display()
            )
        })?,
    );
    let scene = Scene::load(&vendor_dir())?;
    let instructions = Instructions::kitchen().seen;
    let total = instructions.len() as u64 * settings.episodes_per_instruction as u64;
    let bar = ProgressBar::new(total).with_style(ProgressStyle::with_template(
        "{bar:30} {pos}/{len} demonstrations, {msg} discarded [{elapsed} < {eta}]",
    )?);
    bar.enable_steady_tick(Duration::from_millis(200));
    let mut discarded = 0;
    let collected = collect(&scene, &instructions, &settings, |success| {
        if success {
            bar.inc(1);
        } else {
            discarded += 1;
        }
        bar.set_message(discarded.to_string());
    });
    bar.finish_and_clear();
    let (dataset, tallies) = collected?;
    dataset.write(&arguments.output)?;
    print_summary(&dataset, &tallies, &arguments.output);
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
