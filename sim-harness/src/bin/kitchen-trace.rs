//! Steps the kitchen from a pipe at full precision, for the parity test against the official environment.
//!
//! Each input line is either `reset NOISE SEED INSTRUCTION EPISODE` (NOISE: none, v0 or v1) or an action as a JSON array of nine numbers.
//! Each answer is one line of JSON: `{"observation": [...], "state": [...], "completions": [["kettle", 40], ...]}`.
//! `demonstrate SUB-TASK,SUB-TASK,...` answers `{"actions": [[...], ...]}`: what an expert executes without any noise after a reset.

use std::io::{BufRead, Write};
use std::process::ExitCode;

use lads_sim::assets::vendor_dir;
use lads_sim::environment::{Environment, EpisodeSeed};
use lads_sim::expert::{Performer, Style};
use lads_sim::kitchen::spec::{MAX_STEPS, SUB_TASK_NAMES};
use lads_sim::kitchen::{Kitchen, Noise, Scene};
use lads_sim::random::Stream;
use serde_json::json;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("kitchen-trace: {error}");
            ExitCode::from(2)
        }
    }
}

fn run() -> Result<(), Box<dyn std::error::Error>> {
    let scene = Scene::load(&vendor_dir())?;
    let mut kitchen = Kitchen::new(&scene, Noise::None);
    let mut output = std::io::stdout().lock();
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        if let Some(reset) = line.strip_prefix("reset ") {
            let (noise, seed) = parse_reset(reset)?;
            kitchen = Kitchen::new(&scene, noise);
            kitchen.reset(seed, &[]);
        } else if let Some(sub_tasks) = line.strip_prefix("demonstrate ") {
            writeln!(
                output,
                "{}",
                json!({ "actions": demonstrate(&scene, sub_tasks)? })
            )?;
            output.flush()?;
            continue;
        } else {
            kitchen.step(&parse_action(&line)?)?;
        }
        let names = kitchen.sub_tasks();
        let completions: Vec<_> = kitchen
            .completions()
            .iter()
            .map(|completion| (names[completion.sub_task], completion.step))
            .collect();
        let answer = json!({
            "observation": kitchen.observation(),
            "state": kitchen.state(),
            "completions": completions,
        });
        writeln!(output, "{answer}")?;
        output.flush()?;
    }
    Ok(())
}

fn demonstrate(scene: &Scene, sub_tasks: &str) -> Result<Vec<Vec<f32>>, String> {
    let mut kitchen = Kitchen::new(scene, Noise::None);
    let seed = EpisodeSeed {
        seed: 0,
        instruction: 0,
        episode: 0,
    };
    let stream = Stream::new(&seed.entropy());
    let mut performer = Performer::with_style(&mut kitchen, seed, stream, Style::PLAIN, MAX_STEPS);
    for name in sub_tasks.split(',') {
        let index = SUB_TASK_NAMES.iter().position(|known| *known == name);
        let index = index.ok_or_else(|| format!("\"{name}\" is not a sub-task of the kitchen"))?;
        performer
            .perform(index)
            .map_err(|_| format!("the time ran out during \"{name}\""))?;
    }
    Ok(performer
        .transitions()
        .iter()
        .map(|transition| transition.executed.to_vec())
        .collect())
}

fn parse_reset(text: &str) -> Result<(Noise, EpisodeSeed), String> {
    let words: Vec<&str> = text.split_whitespace().collect();
    let [noise, seed, instruction, episode] = words[..] else {
        return Err(format!(
            "\"reset {text}\": expected reset NOISE SEED INSTRUCTION EPISODE"
        ));
    };
    let number = |word: &str| {
        word.parse::<u64>()
            .map_err(|error| format!("\"{word}\": {error}"))
    };
    let seed = EpisodeSeed {
        seed: number(seed)?,
        instruction: number(instruction)?,
        episode: number(episode)?,
    };
    Ok((noise.parse()?, seed))
}

/// Parses an action with the standard library's number parser, which rounds correctly; the JSON reader may be off by one unit in the last
/// place.
fn parse_action(line: &str) -> Result<Vec<f64>, String> {
    let inner = line
        .trim()
        .strip_prefix('[')
        .and_then(|rest| rest.strip_suffix(']'));
    let inner = inner.ok_or_else(|| format!("\"{line}\": expected an action as a JSON array"))?;
    inner
        .split(',')
        .map(|word| {
            word.trim()
                .parse()
                .map_err(|error| format!("\"{}\": {error}", word.trim()))
        })
        .collect()
}
