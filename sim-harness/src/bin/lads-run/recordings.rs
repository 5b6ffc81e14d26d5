//! Jobs and options around recordings: `replay`, `encode`, `--log`, `--plans` and `--monitor`.

use std::fmt::Write as _;
use std::path::Path;
use std::process::ExitCode;

use lads_compiler::Bundle;
use lads_core::Policy;
use lads_sim::environment::Environment;
use lads_sim::evaluate::Evaluation;
use lads_sim::plans::{self, Agreement, PlanBook, PlanFile, PlanSequence};
use lads_sim::recorder::{self, Flight, Log, LogError, Origin};
use lads_sim::replay::{self, Difference};
use lads_sim::trace::Trace;
use lads_sim::{output, results};

use crate::arguments::{Encode, Replay};
use crate::end::{End, print, refused, unwritable};
use crate::program::Program;
use crate::{given, progress};

/// Exit code of a replay whose actions differ from the log.
const DIFFERENT: u8 = 1;

/// Largest number of differences that are printed.
const SHOWN: usize = 10;

fn read(job: &str, path: &Path) -> Result<Log, End> {
    recorder::read(path).map_err(|error| {
        let how = match error {
            LogError::Foreign(_) => " with lads-run --log",
            _ => "",
        };
        refused(format!("{job} {}: {error}{how}", path.display()))
    })
}

/// Runs `replay`: computes the actions of a log again and compares them.
pub fn replay(asked: &Replay) -> Result<ExitCode, End> {
    let program = Program::open(&asked.policy)?;
    program.self_test()?;
    let (policy, path) = (program.policy(), &asked.log);
    let log = read("replay", path)?;
    let about = |error: &dyn std::fmt::Display| {
        refused(format!(
            "replay {}: {error}; name the bundle that it was recorded with",
            path.display()
        ))
    };
    if log
        .flights
        .iter()
        .all(|flight| flight.trace.steps.is_empty())
    {
        let wrong = "it holds no control step, so that nothing would be compared";
        return Err(refused(format!(
            "replay {}: {wrong}; record one",
            path.display()
        )));
    }
    let bar = progress(log.flights.len());
    let replayed = replay::replay(&policy, program.isa(), &log, &|| bar.inc(1));
    bar.finish_and_clear();
    let replayed = replayed.map_err(|error| about(&error))?;

    let mut text = String::new();
    let (was, is) = (&log.origin.bundle_sha256, policy.contract().bundle_sha256());
    if was != is {
        let _ = writeln!(
            text,
            "recorded with another bundle: sha256 {was:.12}, this one {is:.12}"
        );
    }
    for difference in replayed.differences.iter().take(SHOWN) {
        let _ = writeln!(text, "{}", said(difference));
    }
    let more = replayed.differences.len().saturating_sub(SHOWN);
    if more > 0 {
        let _ = writeln!(text, "and {more} more episodes");
    }
    let (episodes, steps) = (replayed.episodes, replayed.steps);
    let different = replayed.differences.len();
    let _ = if different == 0 {
        writeln!(
            text,
            "EQUAL: {episodes} episodes, {steps} control steps, every action and plan bit for bit"
        )
    } else {
        writeln!(
            text,
            "DIFFERENT: {different} of {episodes} episodes, {steps} control steps"
        )
    };
    print(&text)?;
    Ok(if different == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::from(DIFFERENT)
    })
}

fn said(difference: &Difference) -> String {
    let mut line = format!(
        "{} episode {}: differs first at control step {}:",
        difference.instruction, difference.episode, difference.step
    );
    if let Some(plans) = difference.plans {
        let [was, is] = plans.map(|plan| plan.map_or("none".to_owned(), |plan| plan.to_string()));
        let _ = write!(line, " plan {was} in the log, {is} now;");
    }
    if let Some((name, was, is)) = &difference.action {
        let by = (was - is).abs();
        let _ = write!(line, " {name} {was} in the log, {is} now (by {by:.1e})");
    }
    line
}

/// Runs `encode`: prints, or writes, the plans that the trajectory encoder sees in a log.
pub fn encode(asked: &Encode) -> Result<ExitCode, End> {
    let (path, json) = (&asked.log, asked.json.as_deref());
    let inputs = [
        ("--model", Some(&asked.policy.model)),
        ("--image", asked.policy.image.as_ref()),
        ("encode", Some(path)),
    ];
    let outputs = given([("--json", asked.json.as_ref())]);
    output::apart(&given(inputs), &outputs).map_err(refused)?;
    output::check(&[], &outputs).map_err(refused)?;
    let program = Program::open(&asked.policy)?;
    program.self_test()?;
    let policy = program.policy();
    let log = read("encode", path)?;
    let about =
        |error: &dyn std::fmt::Display| refused(format!("encode {}: {error}", path.display()));
    let recordings = log
        .flights
        .iter()
        .map(|flight| flight.trace.steps.as_slice());
    let plans = plans::encode(&policy, program.isa(), recordings).map_err(|error| about(&error))?;
    let sequence = |(flight, plans): (&Flight, Vec<u32>)| PlanSequence {
        instruction: flight.instruction_id.clone(),
        episode: Some(flight.trace.episode),
        plans,
    };
    let sequences = log.flights.iter().zip(plans).map(sequence);
    let (sequences, short): (Vec<_>, Vec<_>) = sequences.partition(|it| !it.plans.is_empty());
    let steps = plans::Segment::of(&policy).map_or(0, |segment| segment.steps);
    let file = PlanFile::new(steps, sequences);
    if let Some(first) = short.first() {
        eprintln!(
            "encode: {} of {} episodes, {} among them, are shorter than the {} control steps of a plan and have none",
            short.len(),
            log.flights.len(),
            first.instruction,
            file.period
        );
    }
    match json {
        Some(path) => {
            output::write_json(&file, path).map_err(|e| unwritable("--json", path, &e))?;
        }
        None => print(&format_args!("{}\n", pretty(&file)))?,
    }
    Ok(ExitCode::SUCCESS)
}

/// Formats a plan file with one line per episode, as people read it.
fn pretty(file: &PlanFile) -> String {
    let lines = file.episodes.iter().map(|sequence| {
        let line = serde_json::to_string(sequence).unwrap_or_default();
        format!("  {line}")
    });
    let lines = lines.collect::<Vec<_>>().join(",\n");
    format!(
        "{{\"format\": \"{}\", \"format_version\": {}, \"horizon\": {}, \"episodes\": [\n{lines}\n]}}",
        file.format, file.format_version, file.period
    )
}

/// Reads a plan file and checks it against the policy.
pub fn plans(policy: &Policy<'_>, bundle: &Bundle, path: &Path) -> Result<PlanBook, End> {
    let index = |wanted: &str| {
        let found = bundle.instruction_indices(wanted);
        found.first().map(|&index| index as u32)
    };
    let read = PlanFile::read(path);
    let book = read.and_then(|file| file.check(policy, bundle.contract().period(), index));
    book.map_err(|error| refused(format!("--plans {}: {error}", path.display())))
}

/// Writes the recorded control steps to the log.
pub fn log(
    evaluation: &Evaluation<'_>,
    environment: &dyn Environment,
    noise: &str,
    traces: &[Trace],
    path: &Path,
) -> Result<(), End> {
    let flight = |trace: &Trace| {
        let known = evaluation.instruction(trace.instruction)?;
        let words = evaluation.setup.words;
        let words = words.and_then(|book| book.of(trace.instruction));
        let watched = environment.sub_tasks();
        let completed = trace.outcome.completions.iter();
        let completed = completed.filter_map(|done| watched.get(done.sub_task));
        Some(Flight {
            instruction_id: known.id.to_owned(),
            instruction_text: known.text.to_owned(),
            words: words.map(<[f32]>::to_vec),
            completed: completed.map(|&name| name.to_owned()).collect(),
            trace: trace.clone(),
        })
    };
    let mut notes = results::versions();
    let faults = serde_json::to_string(&evaluation.setup.faults).unwrap_or_default();
    notes.insert("faults".to_owned(), faults);
    let log = Log {
        origin: Origin {
            environment: environment.id().to_owned(),
            environment_version: environment.version().to_owned(),
            seed: evaluation.seed,
            noise: noise.to_owned(),
            control_period_s: environment.control_period_s(),
            notes,
            ..Origin::of(&evaluation.policy)
        },
        flights: traces.iter().filter_map(flight).collect(),
    };
    let written = || -> Result<(), Box<dyn std::error::Error>> {
        let mut draft = output::draft(path)?;
        recorder::write(&log, draft.as_file_mut())?;
        Ok(draft.commit()?)
    };
    written().map_err(|error| unwritable("--log", path, &error))
}

/// Formats the monitor's table.
pub fn agreement(agreement: &Agreement) -> String {
    let mut text = String::new();
    let Agreement {
        agreed, segments, ..
    } = agreement;
    let _ = write!(
        text,
        "\nmonitor: {agreed} of {segments} executed segments are encoded as the plan in force"
    );
    if let Some(interval) = agreement.interval {
        let share = *agreed as f64 / (*segments).max(1) as f64;
        let _ = write!(text, " ({share:.3} {interval})");
    }
    text.push('\n');
    for (plan, seen) in &agreement.encoded_as {
        let total: usize = seen.values().sum();
        let same = seen.get(plan).copied().unwrap_or(0);
        let mut others: Vec<_> = seen.iter().filter(|(other, _)| *other != plan).collect();
        others.sort_by_key(|&(_, &count)| std::cmp::Reverse(count));
        let others = others.iter().take(5);
        let others: Vec<_> = others
            .map(|(plan, count)| format!("{plan} ({count})"))
            .collect();
        let _ = writeln!(
            text,
            "  plan {plan:>3}: {same:>5} of {total:<5} also seen as {}",
            if others.is_empty() {
                "no other".to_owned()
            } else {
                others.join(", ")
            }
        );
    }
    text
}
