//! Measures the first step of a process. Every sample is a process of its own (this program, called with `--cold`), which opens a compiled
//! image, takes its first steps, and then measures the same steps again in warm caches.

use std::path::Path;
use std::process::Command;

use lads_core::{Controller, Instruction, Policy};
use lads_host::Memory;
use lads_pace::BenchError;
use lads_pace::clock::now;
use lads_pace::contender::Episode;
use lads_pace::stats::{median, quantile};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// Number of episodes that are measured again, hot.
const AGAIN: usize = 40;

/// Durations of one process, in nanoseconds.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Start {
    /// Opening the image.
    open: u64,
    /// Allocating memory and making the controller.
    prepare: u64,
    /// Warming up, where it was asked for.
    warm: u64,
    /// The first instruction.
    instruct: u64,
    /// The first control step, which decides.
    first: u64,
    /// The second control step, which does not decide.
    second: u64,
    /// Instruction, first and second control step once more, hot.
    hot: [u64; 3],
}

fn timed<R>(call: impl FnOnce() -> R) -> (R, u64) {
    let start = now();
    let result = call();
    (result, now() - start)
}

fn refused(error: impl std::fmt::Display) -> BenchError {
    BenchError::new("the compiled image", error, "compile it again")
}

/// Runs the process that was started with `--cold`; prints its durations.
pub fn child(image: &Path, warm: bool) -> Result<(), BenchError> {
    let file = std::fs::read(image).map_err(refused)?;
    // Words, for the image's alignment.
    let words: Vec<u32> = file
        .chunks_exact(4)
        .map(|c| u32::from_ne_bytes([c[0], c[1], c[2], c[3]]))
        .collect();
    let bytes: &[u8] = bytemuck::cast_slice(&words);
    let (policy, open) = timed(|| Policy::new_checked(bytes));
    let policy = policy.map_err(refused)?;
    let episode = Episode::of(&policy)?;
    let mut memory = Memory::of(&policy).map_err(refused)?;
    let (controller, prepare) = timed(|| memory.controller(&policy));
    let mut controller = controller.map_err(refused)?;
    // What a robot does before its policy starts: other work, which takes the caches.
    let mut other = vec![1_u64; 8 * 1024 * 1024];
    for x in &mut other {
        *x = x.wrapping_mul(3);
    }
    std::hint::black_box(&other);
    let ((), warm) = timed(|| {
        if warm {
            controller.warm();
        }
    });
    let [instruct, first, second] = begin(&mut controller, &episode)?;
    let again = (0..AGAIN).map(|_| begin(&mut controller, &episode));
    let again = again.collect::<Result<Vec<_>, _>>()?;
    let hot = [0, 1, 2].map(|i| {
        let took: Vec<_> = again.iter().map(|times| times[i] as f64).collect();
        median(&took) as u64
    });
    let start = Start {
        open,
        prepare,
        warm,
        instruct,
        first,
        second,
        hot,
    };
    println!("{}", serde_json::to_string(&start).map_err(refused)?);
    Ok(())
}

/// Sets an instruction and runs two steps.
fn begin(controller: &mut Controller<'_, '_>, episode: &Episode) -> Result<[u64; 3], BenchError> {
    let mut action = vec![0.0; episode.limits.len()];
    let instruction = Instruction::Id(episode.instruction.unwrap_or(0));
    let (done, instruct) = timed(|| controller.set_instruction(instruction));
    done.map_err(refused)?;
    let mut step = |step| {
        let (done, took) = timed(|| controller.step(episode.observation(step), &mut action));
        done.map(|_| took).map_err(refused)
    };
    Ok([instruct, step(0)?, step(1)?])
}

/// Starts `processes` processes of either kind in turns and sums them up, in microseconds.
pub fn measure(image: &Path, processes: usize) -> Result<Value, BenchError> {
    let program = std::env::current_exe().map_err(refused)?;
    let run = |warm: bool| -> Result<Start, BenchError> {
        let mut command = Command::new(&program);
        command.arg("--cold").arg(image);
        if warm {
            command.arg("--warm");
        }
        let output = command.output().map_err(refused)?;
        serde_json::from_slice(&output.stdout).map_err(refused)
    };
    let (mut cold, mut warm) = (vec![], vec![]);
    for _ in 0..processes {
        cold.push(run(false)?);
        warm.push(run(true)?);
    }
    Ok(json!({ "without": summary(&cold), "with": summary(&warm) }))
}

fn summary(starts: &[Start]) -> Value {
    let us = |of: fn(&Start) -> u64| {
        median(
            &starts
                .iter()
                .map(|s| of(s) as f64 / 1e3)
                .collect::<Vec<_>>(),
        )
    };
    let ratio = |of: fn(&Start) -> f64| {
        let ratios: Vec<_> = starts.iter().map(of).collect();
        json!({ "median": median(&ratios), "low": quantile(&ratios, 0.25), "high": quantile(&ratios, 0.75) })
    };
    json!({
        "processes": starts.len(),
        "open_us": us(|s| s.open),
        "prepare_us": us(|s| s.prepare),
        "warm_us": us(|s| s.warm),
        "instruct_us": us(|s| s.instruct),
        "first_us": us(|s| s.first),
        "second_us": us(|s| s.second),
        "hot_first_us": us(|s| s.hot[1]),
        "hot_second_us": us(|s| s.hot[2]),
        "first_to_hot": ratio(|s| s.first as f64 / s.hot[1] as f64),
        "second_to_hot": ratio(|s| s.second as f64 / s.hot[2] as f64),
    })
}
