//! The command line: options of the main job, and the other jobs as subcommands. Options that several jobs share are grouped in structs.

use std::path::{Path, PathBuf};

use clap::{ArgMatches, Args, Command, CommandFactory, FromArgMatches, Parser, Subcommand};
use lads_sim::faults::Faults;
use lads_sim::rollout::Pictures;

/// The job to do: the main job, or a subcommand.
#[derive(Debug)]
pub enum Arguments {
    Run(Run),
    Other(Job),
}

impl CommandFactory for Arguments {
    fn command() -> Command {
        Job::augment_subcommands(Run::command())
            .args_conflicts_with_subcommands(true)
            .subcommand_negates_reqs(true)
    }

    fn command_for_update() -> Command {
        Self::command()
    }
}

impl FromArgMatches for Arguments {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        if matches.subcommand_name().is_some() {
            Job::from_arg_matches(matches).map(Self::Other)
        } else {
            Run::from_arg_matches(matches).map(Self::Run)
        }
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

impl Parser for Arguments {}

/// Former options that are subcommands now, each with the name of its subcommand.
pub const MOVED: [(&str, &str); 7] = [
    ("--verify", "lads-run verify --model MODEL"),
    ("--replay", "lads-run replay LOG --model MODEL"),
    ("--encode", "lads-run encode LOG --model MODEL"),
    ("--sweep", "lads-run sweep --model MODEL"),
    ("--viewer", "lads-run view --model MODEL"),
    ("--record", "lads-run record OUT --model MODEL"),
    (
        "--record-episode",
        "lads-run record OUT --model MODEL --episode NUMBER",
    ),
];

/// Runs a policy bundle in simulation over its instructions; prints success rates and control-step latency.
#[derive(Debug, Parser)]
#[command(name = "lads-run", version)]
pub struct Run {
    #[command(flatten)]
    pub rollouts: Rollouts,
    /// Draw uniform random actions instead of asking the policy: the floor that it is measured against
    #[arg(long, conflicts_with_all = ["sample", "log", "plans", "monitor", "report", "encode_language"])]
    pub uniform: bool,
    /// Write success rates and charts to this file as one HTML page (needs the cargo feature `report`)
    #[arg(long, value_name = "HTML")]
    pub report: Option<PathBuf>,
}

/// Subcommands besides the main job.
#[derive(Debug, Subcommand)]
pub enum Job {
    /// Run the episodes of a reference and say whether the policy is the reference's: exit code 0 EQUIVALENT, 1 DIFFERENT, 3 INCONCLUSIVE
    Verify(Verify),
    /// Find the smallest formats of weights and caches that keep every plan of a reference's questions, and write them with the evidence into
    /// the bundle, where everything that compiles it finds them
    Tune(Tune),
    /// Compute the actions of a log again and name the first step that differs (exit code 1); runs no episode
    Replay(Replay),
    /// Print the plans that the trajectory encoder sees in a log, in the form that --plans takes; runs no episode
    Encode(Encode),
    /// Run the benchmark once for each of several levels of each fault and print N-rate against them
    Sweep(Sweep),
    /// Open a window in which the policy runs at real time, one episode after the other (needs the cargo feature `viewer`, an X display and
    /// EGL): mouse for the camera, keys to pause, step, change the speed and start again. Closing it ends the run with what was finished
    View(Rollouts),
    /// Run the episodes, and film one of the first instruction (needs the cargo feature `record`, and EGL, which needs no display)
    Record(Record),
    /// Compare policies in one environment on one HTML page (needs the cargo feature `report`): success rates of all inputs, and what each
    /// bundle does in its episodes
    Report(Compared),
    /// Draw what the environment's camera sees in every state of a dataset, for training on images (needs the cargo feature `camera`, and
    /// EGL); goes on where it was stopped
    Frames(Frames),
}

/// Options that choose the policy and how its kernels run.
#[derive(Debug, Args)]
pub struct PolicyArguments {
    /// The policy bundle (ONNX)
    #[arg(long)]
    pub model: PathBuf,
    /// Run this program image of the bundle, made by `lads compile`, for instance with weights or a cache of fewer bits; left out, the
    /// bundle is compiled as it was tuned, and with 32 bits where it was not
    #[arg(long, value_name = "LADS")]
    pub image: Option<PathBuf>,
    /// Instructions that the kernels run on; left out, the widest of this CPU. The results have the same bits on all
    #[arg(long)]
    pub isa: Option<IsaName>,
    /// Compiles the bundle with 32 bits, whatever formats it was tuned to.
    #[arg(skip)]
    pub exact: bool,
}

/// Instruction sets by the names that [`lads_core::Isa::name`] gives, other processors' included.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
pub enum IsaName {
    Portable,
    Avx2,
    Avx512,
    Neon,
    Dotprod,
}

/// Options that choose which episodes run.
#[derive(Debug, Args)]
pub struct EpisodeArguments {
    /// Run only this instruction, by its text or its id; any other sentence goes through the language encoder
    #[arg(long)]
    pub instruction: Option<String>,
    /// Episodes of each instruction
    #[arg(long, default_value_t = 2)]
    pub episodes: u32,
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
}

/// Options for instructions that are not in the bundle's table.
#[derive(Debug, Default, Args)]
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
    #[arg(long)]
    pub encode_language: bool,
    /// Folder of the language encoder; left out, where "make language" puts it
    #[arg(long, value_name = "FOLDER")]
    pub encoder: Option<PathBuf>,
}

/// Options that simulate a real robot's imperfections.
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
}

impl FaultArguments {
    /// Returns the faults that these options ask for.
    pub fn faults(&self) -> Faults {
        Faults {
            delay_steps: self.delay_steps,
            drop_rate: self.drop_rate,
            noise_scale: self.noise_scale,
            action_lag: self.action_lag,
        }
    }
}

/// Options for files to write and to read.
#[derive(Debug, Args)]
#[command(next_help_heading = "Results, recordings and plans")]
pub struct FileArguments {
    /// Write the results to this file as JSON (its form: sim-harness/proof/results.schema.json)
    #[arg(long)]
    pub json: Option<PathBuf>,
    /// Record every control step into this MCAP file, which Foxglove opens
    #[arg(long)]
    pub log: Option<PathBuf>,
    /// Let the policy follow the plans in this file instead of its own; an episode ends with its plans
    #[arg(long, value_name = "FILE")]
    pub plans: Option<PathBuf>,
    /// Encode every executed segment and report how often it is the plan that was in force
    #[arg(long)]
    pub monitor: bool,
}

/// Options of a run of episodes, with everything that may be asked of it.
#[derive(Debug, Args)]
pub struct Rollouts {
    #[command(flatten)]
    pub policy: PolicyArguments,
    #[command(flatten)]
    pub episodes: EpisodeArguments,
    #[command(flatten)]
    pub files: FileArguments,
    #[command(flatten)]
    pub language: LanguageArguments,
    #[command(flatten)]
    pub faults: FaultArguments,
}

/// Options of `lads-run verify`.
#[derive(Debug, Args)]
pub struct Verify {
    #[command(flatten)]
    pub policy: PolicyArguments,
    /// The reference; left out, the file beside the model that ends in .reference.json
    #[arg(long, value_name = "FILE")]
    pub reference: Option<PathBuf>,
    /// Write the certificate to this file, as JSON (its form: sim-harness/proof/certificate.schema.json) or, where it ends in .html, as a
    /// page; may be given twice
    #[arg(long, value_name = "FILE")]
    pub certificate: Vec<PathBuf>,
    /// Run only this instruction, by its text or its id
    #[arg(long)]
    pub instruction: Option<String>,
    /// Episodes of each instruction; left out, all that the reference has
    #[arg(long)]
    pub episodes: Option<u32>,
    /// Threads; left out, one per core
    #[arg(long)]
    pub threads: Option<usize>,
}

/// Returns the path of the reference: the one that was named, else the file beside the model.
pub fn reference(named: Option<&Path>, model: &Path) -> PathBuf {
    let beside = || model.with_extension("reference.json");
    named.map_or_else(beside, Path::to_owned)
}

/// Options of `lads-run tune`.
#[derive(Debug, Args)]
pub struct Tune {
    /// The policy bundle (ONNX)
    #[arg(long)]
    pub model: PathBuf,
    /// The reference, whose traced episodes are the questions; left out, the file beside the model that ends in .reference.json
    #[arg(long, value_name = "FILE")]
    pub reference: Option<PathBuf>,
    /// Write the bundle to this file; left out, it replaces the model
    #[arg(short, long, value_name = "FILE")]
    pub output: Option<PathBuf>,
    /// Instructions that the kernels run on; left out, the widest of this CPU. The results have the same bits on all
    #[arg(long)]
    pub isa: Option<IsaName>,
}

/// Options of `lads-run replay`.
#[derive(Debug, Args)]
pub struct Replay {
    /// The log, made with --log
    pub log: PathBuf,
    #[command(flatten)]
    pub policy: PolicyArguments,
}

/// Options of `lads-run encode`.
#[derive(Debug, Args)]
pub struct Encode {
    /// The log, made with --log
    pub log: PathBuf,
    #[command(flatten)]
    pub policy: PolicyArguments,
    /// Write the plans to this file instead
    #[arg(long)]
    pub json: Option<PathBuf>,
}

/// Options of `lads-run sweep`.
#[derive(Debug, Args)]
pub struct Sweep {
    #[command(flatten)]
    pub policy: PolicyArguments,
    #[command(flatten)]
    pub episodes: EpisodeArguments,
    /// Write the results to this file as JSON
    #[arg(long)]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    pub language: LanguageArguments,
}

/// Options of `lads-run record`.
#[derive(Debug, Args)]
pub struct Record {
    /// The film: .gif, .mp4 (by ffmpeg), or with a slash at its end a folder of PNG
    pub out: PathBuf,
    /// Which episode of the first instruction that runs is filmed, from 0
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    pub episode: u32,
    #[command(flatten)]
    pub rollouts: Rollouts,
}

/// Options of `lads-run report`.
#[derive(Debug, Args)]
pub struct Compared {
    /// What is compared: bundles (ONNX), whose episodes are run; results that --json wrote; tables that "make table" wrote
    #[arg(required = true, value_name = "INPUT")]
    pub inputs: Vec<PathBuf>,
    /// The page
    #[arg(short, long, value_name = "HTML")]
    pub output: PathBuf,
    /// Take only this table of a file of tables, by its name
    #[arg(long, value_name = "NAME")]
    pub table: Option<String>,
    #[command(flatten)]
    pub episodes: EpisodeArguments,
    /// Instructions that the kernels run on; left out, the widest of this CPU. The results have the same bits on all
    #[arg(long)]
    pub isa: Option<IsaName>,
}

/// Options of `lads-run frames`.
#[derive(Debug, Args)]
pub struct Frames {
    /// The dataset, made by lads-collect
    #[arg(required_unless_present = "stream", conflicts_with = "stream")]
    pub data: Option<PathBuf>,
    /// The frames, a safetensors file: a cache, which the dataset makes again
    #[arg(
        short,
        long,
        value_name = "FILE",
        required_unless_present = "stream",
        conflicts_with = "stream"
    )]
    pub output: Option<PathBuf>,
    /// Draw states that come on the standard input, for another program, to the standard output: sim-harness/src/frames/stream.rs has the form
    #[arg(long, value_name = "ENVIRONMENT", conflicts_with = "threads")]
    pub stream: Option<String>,
    /// Rendering of the frames, as JSON (its form: the `rendering` of a bundle's image channel); left out, as the environment's benchmark has it
    #[arg(long, value_name = "FILE")]
    pub rendering: Option<PathBuf>,
    /// Threads; left out, one per core
    #[arg(long)]
    pub threads: Option<usize>,
}

/// Episodes that a job runs and how, in a form common to all jobs.
pub struct Wanted<'a> {
    pub policy: &'a PolicyArguments,
    pub language: &'a LanguageArguments,
    pub instruction: Option<&'a str>,
    pub episodes: u32,
    pub seed: u64,
    pub noise: Option<&'a str>,
    pub sample: bool,
    pub uniform: bool,
    pub faults: Faults,
    pub plans: Option<&'a Path>,
    /// Number of episodes per instruction whose control steps are kept.
    pub traced: u32,
    /// Which of these keep what the cameras showed.
    pub pictures: Pictures,
    pub threads: usize,
    /// The job or option that excludes a sentence outside the bundle's table, if there is one.
    pub of_table: Option<&'static str>,
    /// Whether a sentence outside the table must come with the sub-tasks that judge it.
    pub judged: bool,
}

impl<'a> Wanted<'a> {
    /// The policy's episodes as asked, without anything else: no traces and pictures, no faults, no plans from a file.
    pub fn of(
        policy: &'a PolicyArguments,
        language: &'a LanguageArguments,
        episodes: &'a EpisodeArguments,
        threads: usize,
    ) -> Self {
        Self {
            policy,
            language,
            instruction: episodes.instruction.as_deref(),
            episodes: episodes.episodes,
            seed: episodes.seed,
            noise: episodes.noise.as_deref(),
            sample: episodes.sample,
            uniform: false,
            faults: Faults::default(),
            plans: None,
            traced: 0,
            pictures: Pictures::None,
            threads,
            of_table: None,
            judged: false,
        }
    }
}
