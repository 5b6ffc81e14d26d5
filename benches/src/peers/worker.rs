//! Runs a contender in Python: PyTorch or OpenVINO, in a process of its own that measures itself by the same protocol.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde_json::{Value, json};

use super::engine::failed;
use lads_pace::BenchError;
use lads_pace::clock::Pace;
use lads_pace::contender::{Block, Computed, Contender, Episode, Kind, Sample, Work};

/// Names of the contenders that the script knows.
pub const NAMES: [&str; 2] = ["PyTorch", "OpenVINO"];

/// The process of a Python contender, and its pipes.
#[derive(Debug)]
pub struct Worker {
    name: &'static str,
    detail: String,
    recomputes: bool,
    child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
}

impl Worker {
    /// Starts `python` on the script, which loads the bundle.
    pub fn new(
        name: &'static str,
        python: &Path,
        bundle: &Path,
        episode: &Episode,
    ) -> Result<Self, BenchError> {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/worker.py");
        let mut child = Command::new(python)
            .arg(script)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .map_err(|error| failed(name, format!("{}: {error}", python.display())))?;
        let no_pipe = || failed(name, "its process has no pipe");
        let input = child.stdin.take().ok_or_else(no_pipe)?;
        let output = BufReader::new(child.stdout.take().ok_or_else(no_pipe)?);
        let mut worker = Self {
            name,
            detail: String::new(),
            recomputes: false,
            child,
            input,
            output,
        };
        let reply = worker.ask(&json!({
            "command": "open",
            "name": name,
            "bundle": bundle,
            "episode": { "instruction": episode.instruction, "observations": episode.observations },
        }))?;
        reply["detail"]
            .as_str()
            .unwrap_or_default()
            .clone_into(&mut worker.detail);
        worker.recomputes = reply["recompute"].as_bool().unwrap_or(false);
        Ok(worker)
    }

    fn ask(&mut self, request: &Value) -> Result<Value, BenchError> {
        let name = self.name;
        writeln!(self.input, "{request}").map_err(|error| failed(name, error))?;
        let mut line = String::new();
        self.output
            .read_line(&mut line)
            .map_err(|error| failed(name, error))?;
        let reply: Value =
            serde_json::from_str(&line).map_err(|_| failed(name, "its process ended"))?;
        match reply["error"].as_str() {
            Some(error) => Err(failed(name, error)),
            None => Ok(reply),
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        // It would end with its input anyway.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Contender for Worker {
    fn name(&self) -> &str {
        self.name
    }

    fn detail(&self) -> String {
        self.detail.clone()
    }

    fn replay(&mut self, steps: usize) -> Result<Vec<Computed>, BenchError> {
        let reply = self.ask(&json!({ "command": "replay", "steps": steps }))?;
        let broken = || failed(self.name, "its answer has no plans and actions");
        let plans: Vec<u32> =
            serde_json::from_value(reply["plans"].clone()).map_err(|_| broken())?;
        let actions: Vec<Vec<f32>> =
            serde_json::from_value(reply["actions"].clone()).map_err(|_| broken())?;
        Ok(plans
            .into_iter()
            .zip(actions)
            .map(|(plan, action)| Computed {
                selected: Some(plan),
                action,
            })
            .collect())
    }

    fn offers(&self, work: Work) -> bool {
        !matches!(work, Work::Recompute { .. }) || self.recomputes
    }

    fn block(&mut self, block: &Block, samples: &mut Vec<Sample>) -> Result<(), BenchError> {
        let (work, first) = match block.work {
            Work::Act => ("act", 0),
            Work::Steps { first } => ("steps", first),
            Work::Instruct => ("instruct", 0),
            Work::Recompute { step } => ("recompute", step),
        };
        let period = match block.pace {
            Pace::Hot => 0,
            Pace::Every(period) => period.as_nanos() as u64,
        };
        let reply = self.ask(&json!({
            "command": "block",
            "work": work,
            "first": first,
            "middle": block.middle(),
            "calls": block.calls,
            "settle": block.settle,
            "period": period,
            "fifo": period > 0,
        }))?;
        let measured: Vec<(String, u64, u64)> = serde_json::from_value(reply["samples"].clone())
            .map_err(|_| failed(self.name, "its answer has no samples"))?;
        for (kind, late, took) in measured {
            let kind = Kind::ALL.into_iter().find(|known| known.name() == kind);
            let kind = kind.ok_or_else(|| failed(self.name, "a sample of an unknown kind"))?;
            samples.push(Sample {
                kind,
                step: block.middle(),
                late,
                took,
            });
        }
        Ok(())
    }
}
