//! The command line.

use std::path::PathBuf;

use clap::{Args, Parser};
use lads_sim::faults::Faults;

/// Runs a policy bundle in simulation over its instructions; prints success rates and control-step latency.
#[derive(Debug, Parser)]
#[command(version)]
pub struct Arguments {
    /// The policy bundle (ONNX)
    #[arg(long)]
    pub model: PathBuf,
    /// Run this program image of the bundle, made by `lads compile`, for instance with weights or a cache of fewer bits; left out, the
    /// bundle is compiled with 32-bit weights
    #[arg(long, value_name = "LADS")]
    pub image: Option<PathBuf>,
    /// Run only this instruction, by its text or its id; any other sentence goes through the language encoder
    #[arg(long)]
    pub instruction: Option<String>,
    /// Episodes of each instruction; left out, 2, and with --verify all that the reference has
    #[arg(long)]
    pub episodes: Option<u32>,
    /// Seed of all random streams; the same seed gives the same episodes on any number of threads
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Observation noise: in the kitchen v0 (D4RL's, the default), v1 (Gymnasium-Robotics') or none
    #[arg(long)]
    pub noise: Option<String>,
    /// Threads; left out, one per core
    #[arg(long)]
    pub threads: Option<usize>,
    /// Sample plans from the policy's distribution instead of taking the likeliest
    #[arg(long)]
    pub sample: bool,
    /// Draw uniform random actions instead of asking the policy: the floor that it is measured against
    #[arg(long, conflicts_with_all = ["sample", "log", "plans", "monitor", "report", "record", "sweep"])]
    pub uniform: bool,
    /// Write the results to this file as JSON (its form: sim-harness/proof/results.schema.json); of --encode, the plans
    #[arg(long)]
    pub json: Option<PathBuf>,
    /// Instructions that the kernels run on; left out, the widest of this CPU. The results have the same bits on all
    #[arg(long)]
    pub isa: Option<IsaName>,
    /// Run the episodes of a reference and say whether the policy is the reference's: exit code 0 EQUIVALENT, 1 DIFFERENT, 3 INCONCLUSIVE.
    /// Left out, REFERENCE is the file beside the model that ends in .reference.json
    #[arg(long, value_name = "REFERENCE", num_args = 0..=1, conflicts_with_all = ["seed", "noise", "sample", "uniform", "json", "report", "record", "log", "replay", "encode", "plans", "monitor", "sweep", "delay_steps", "drop_rate", "noise_scale", "action_lag"])]
    #[expect(
        clippy::option_option,
        reason = "clap's form of an option whose value may be left out"
    )]
    pub verify: Option<Option<PathBuf>>,
    /// Write the certificate of --verify to this file, as JSON (its form: sim-harness/proof/certificate.schema.json) or, where it ends in .html, as
    /// a page; may be given twice
    #[arg(long, requires = "verify")]
    pub certificate: Vec<PathBuf>,
    /// Write success rates and charts to this file as one HTML page (needs the cargo feature `report`)
    #[arg(long, value_name = "HTML")]
    pub report: Option<PathBuf>,
    /// Open a window in which the policy runs at real time, one episode after the other (needs the cargo feature `viewer`, an X display and
    /// EGL): mouse for the camera, keys to pause, step, change the speed and start again. Closing it ends the run with what was finished
    #[arg(long, conflicts_with_all = ["uniform", "verify", "sweep", "replay", "encode", "report", "record"])]
    pub viewer: bool,
    #[command(flatten)]
    pub language: LanguageArguments,
    #[command(flatten)]
    pub recordings: RecordingArguments,
    #[command(flatten)]
    pub faults: FaultArguments,
}

/// Instruction sets by name.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
pub enum IsaName {
    Portable,
    Avx2,
    Avx512,
}

/// Words that the bundle does not bring.
#[derive(Debug, Args)]
#[command(next_help_heading = "Language (cargo feature `language`)")]
pub struct LanguageArguments {
    /// What a sentence outside the bundle's table asks for, separated by commas: the episodes start, last and are judged as the benchmark's
    /// episodes of these sub-tasks. Left out, they last their full time and have no success rate
    #[arg(long, value_name = "SUB-TASKS")]
    pub sub_tasks: Option<String>,
    /// Follow a sentence outside the bundle's table even where it is less like a known instruction than the bundle's contract asks for
    #[arg(long, requires = "instruction")]
    pub sentence_anyway: bool,
    /// Take no word embeddings from the bundle's table: the language encoder hears every instruction
    #[arg(long, conflicts_with_all = ["verify", "replay", "encode", "uniform"])]
    pub encode_language: bool,
    /// Folder of the language encoder; left out, where "make language" puts it
    #[arg(long, value_name = "FOLDER")]
    pub encoder: Option<PathBuf>,
}

/// Episodes on file.
#[derive(Debug, Args)]
#[command(next_help_heading = "Recordings and plans")]
pub struct RecordingArguments {
    /// Record every control step into this MCAP file, which Foxglove opens
    #[arg(long)]
    pub log: Option<PathBuf>,
    /// Film an episode of the first instruction that runs into this file: .gif, .mp4 (by ffmpeg), or with a slash at its end a folder of
    /// PNG; needs the cargo feature `record`, and EGL, which needs no display
    #[arg(long, value_name = "OUT")]
    pub record: Option<PathBuf>,
    /// Which of its episodes, from 0
    #[arg(long, value_name = "NUMBER", default_value_t = 0, requires = "record")]
    pub record_episode: u32,
    /// Run nothing: compute the actions of a log again and name the first step that differs (exit code 1)
    #[arg(long, value_name = "LOG", conflicts_with_all = ["log", "encode", "plans", "monitor", "json", "instruction", "report", "record", "sweep"])]
    pub replay: Option<PathBuf>,
    /// Run nothing: print the plans that the trajectory encoder sees in a log, in the form that --plans takes
    #[arg(long, value_name = "LOG", conflicts_with_all = ["log", "plans", "monitor", "instruction", "report", "record", "sweep"])]
    pub encode: Option<PathBuf>,
    /// Run the low level alone on the plans in this file; an episode ends with its plans
    #[arg(long, value_name = "FILE")]
    pub plans: Option<PathBuf>,
    /// Encode every executed segment and report how often it is the plan that was in force
    #[arg(long)]
    pub monitor: bool,
}

/// A real robot's imperfections.
#[derive(Debug, Args)]
#[command(next_help_heading = "Faults between policy and environment")]
pub struct FaultArguments {
    /// Control steps by which observations come late
    #[arg(long, value_name = "STEPS", default_value_t = 0)]
    pub delay_steps: usize,
    /// Share of observations that are lost; the last one stays in use
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    pub drop_rate: f64,
    /// Factor on the environment's observation noise, as the policy sees it
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0)]
    pub noise_scale: f64,
    /// Time constant of a first-order lag of the actuators, in control steps
    #[arg(long, value_name = "STEPS", default_value_t = 0.0)]
    pub action_lag: f64,
    /// Run the benchmark once for each of several levels of each fault and print N-rate against them
    #[arg(long, conflicts_with_all = ["log", "report", "record", "plans", "monitor", "delay_steps", "drop_rate", "noise_scale", "action_lag"])]
    pub sweep: bool,
}

impl FaultArguments {
    /// The faults that they ask for.
    pub fn faults(&self) -> Faults {
        Faults {
            delay_steps: self.delay_steps,
            drop_rate: self.drop_rate,
            noise_scale: self.noise_scale,
            action_lag: self.action_lag,
        }
    }
}
