//! Runs many episodes on many threads, with the same result whatever their number.
//!
//! Each thread has its own environment and its own controller and takes the next episode from one queue. Every episode draws from streams
//! of its own (seed, instruction, episode), and results are put in the order of the queue, so scheduling cannot show. What can fail: an
//! episode that does not finish, or a panic in one; then all threads stop after their current episode.

use std::panic::resume_unwind;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use lads_compiler::{CompileError, Contract};
use lads_core::{Decision, Isa, Noise, Policy};
use lads_host::{Memory, MemoryError};
use thiserror::Error;

use crate::environment::{Environment, EpisodeSeed};
use crate::faults::Faults;
use crate::plans::PlanBook;
use crate::queue::Queue;
use crate::random::Stream;
use crate::results::{self, Asked};
use crate::rollout::{Actor, Driver, Episode, Observer, Pictures, RolloutError, Task, Timing};
use crate::sight::{Sight, SightError};
use crate::spoken::WordBook;
use crate::trace::Trace;

/// Fourth number of the entropy of the stream that seeds plan sampling; the environment's noise has only the first three.
const DECISION_STREAM: u64 = 1;

/// Fourth number of the entropy of the stream that seeds what a policy draws at random.
const NOISE_STREAM: u64 = 5;

/// An instruction to run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Assignment {
    /// Index of the instruction in the policy's table; beyond the table, of a sentence whose word embeddings the setup has.
    pub instruction: u32,
    /// The environment's indices of the sub-tasks that the instruction commands.
    pub commanded: Vec<usize>,
    /// Number of control steps of the instruction's episodes.
    pub max_steps: usize,
}

/// Setup of episodes besides policy, seed and decision; the default is the plain benchmark.
#[derive(Debug, Clone, Copy, Default)]
pub struct Setup<'e> {
    /// Faults between policy and environment.
    pub faults: Faults,
    /// Plans that the policy is to follow, instead of its own.
    pub plans: Option<&'e PlanBook>,
    /// Word embeddings that replace those of the table.
    pub words: Option<&'e WordBook>,
    /// Whether an episode whose observation the controller refuses ends there and counts with what it has completed, as a machine would
    /// stop; otherwise it ends everything.
    pub stop_where_refused: bool,
    /// Number of each instruction's episodes, from the first, that keep every control step.
    pub traced: u32,
    /// Which of these steps keep what the cameras showed.
    pub pictures: Pictures,
    /// Observer of the policy's episodes.
    pub observer: Option<&'e dyn Observer>,
}

/// An evaluation to run.
pub struct Evaluation<'e> {
    /// The compiled policy.
    pub policy: Policy<'e>,
    /// The contract of its bundle, which also says how instructions are evaluated.
    pub contract: &'e Contract,
    /// The instructions to run.
    pub assignments: &'e [Assignment],
    /// Episodes of each instruction.
    pub episodes: u32,
    /// Seed of all random streams.
    pub seed: u64,
    /// How plans are chosen; a sampling seed in it is replaced by one per episode.
    pub decision: Decision,
    /// Source of the actions.
    pub actor: Actor,
    /// Instruction set that the kernels run on.
    pub isa: Isa,
    /// Number of threads, at least one.
    pub threads: usize,
    /// Everything else about the episodes.
    pub setup: Setup<'e>,
}

/// Why an evaluation gave no result.
#[derive(Debug, Error)]
pub enum EvaluationError {
    /// There is no memory for the policy's controller.
    #[error(transparent)]
    Memory(MemoryError),
    /// The bundle's table of instructions cannot be evaluated, so its image cannot be compared with it.
    #[error(transparent)]
    Bundle(lads_compiler::CompileError),
    /// The policy's cameras cannot be drawn.
    #[error(transparent)]
    Sight(SightError),
    /// Drawn frames cannot be kept.
    #[error(
        "frames cannot be kept in a temporary file: {0}; make room, or name another folder with TMPDIR"
    )]
    Frames(std::io::Error),
    /// An episode could not be finished.
    #[error("episode {episode} of instruction {instruction}: {source}")]
    Rollout {
        /// Index of the instruction.
        instruction: u32,
        /// Number of the episode.
        episode: u32,
        /// The episode's error.
        source: RolloutError,
    },
    /// The policy with 32 bits, with which one with fewer bits is compared, does not compile.
    #[error("with 32 bits: {0}")]
    Exact(CompileError),
    /// The evaluation was stopped by the caller.
    #[error("interrupted")]
    Interrupted,
}

/// Episodes of each assignment in order, and the durations of all.
#[derive(Debug)]
pub struct Evaluated {
    /// One list of episodes per assignment.
    pub episodes: Vec<Vec<Episode>>,
    /// Traces of the episodes in the order of `episodes`, where the setup asked for them; empty otherwise.
    pub traces: Vec<Trace>,
    /// Control steps, from 0, at which episodes ended because the controller refused an observation; empty unless the setup lets episodes
    /// end this way.
    pub refused_at: Vec<usize>,
    /// Durations, summed over the threads.
    pub timing: Timing,
}

/// Episodes that one thread ran, with their places in the queue.
struct Share {
    episodes: Vec<(usize, Episode, Option<Trace>)>,
    refused_at: Vec<usize>,
    timing: Timing,
}

impl Evaluation<'_> {
    /// Number of episodes in all.
    pub fn len(&self) -> usize {
        self.assignments.len() * self.episodes as usize
    }

    /// Finds an instruction by index, in the policy's table or as a sentence outside it.
    pub fn instruction(&self, instruction: u32) -> Option<Asked<'_>> {
        let known = results::asked(self.contract, instruction as usize);
        known.or_else(|| Some(self.setup.words?.sentence.as_ref()?.asked()))
    }

    /// Whether there is nothing to run.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Runs all episodes. `open` makes one environment per thread, `finished` is called after each episode, `stop` ends the work early.
    pub fn run(
        &self,
        open: &(dyn Fn() -> Box<dyn Environment> + Sync),
        stop: &AtomicBool,
        finished: &(dyn Fn() + Sync),
    ) -> Result<Evaluated, EvaluationError> {
        let evaluated = self.run_until(open, stop, finished)?;
        let done: usize = evaluated.episodes.iter().map(Vec::len).sum();
        let whole = done == self.len();
        whole
            .then_some(evaluated)
            .ok_or(EvaluationError::Interrupted)
    }

    /// Runs episodes like [`run`](Self::run), but if stopped early, also by the observer, returns the finished episodes.
    pub fn run_until(
        &self,
        open: &(dyn Fn() -> Box<dyn Environment> + Sync),
        stop: &AtomicBool,
        finished: &(dyn Fn() + Sync),
    ) -> Result<Evaluated, EvaluationError> {
        let queue = Queue::new(0..self.len());
        let next = || {
            let stopped = stop.load(Ordering::Relaxed);
            Some((!stopped).then(|| queue.take(1))??.start)
        };
        let work = || {
            let _halts = queue.halts_on_panic();
            let done = self.worker(open, &next, finished);
            if done.is_err() {
                queue.halt();
            }
            done
        };
        let threads = self.threads.clamp(1, self.len().max(1));
        let outcomes = thread::scope(|scope| {
            let workers: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
            workers
                .into_iter()
                .map(|worker| worker.join().unwrap_or_else(|panic| resume_unwind(panic)))
                .collect::<Vec<_>>()
        });

        let mut timing = Timing::default();
        let mut all = Vec::with_capacity(self.len());
        let mut refused_at = Vec::new();
        for outcome in outcomes {
            let share = outcome?;
            all.extend(share.episodes);
            refused_at.extend(share.refused_at);
            timing.absorb(share.timing);
        }
        refused_at.sort_unstable();
        all.sort_unstable_by_key(|&(place, ..)| place);
        let mut traces = Vec::new();
        let mut episodes = vec![Vec::new(); self.assignments.len()];
        for (place, episode, trace) in all {
            traces.extend(trace);
            if let Some(own) = episodes.get_mut(place / self.episodes as usize) {
                own.push(episode);
            }
        }
        Ok(Evaluated {
            episodes,
            traces,
            refused_at,
            timing,
        })
    }

    fn worker(
        &self,
        open: &dyn Fn() -> Box<dyn Environment>,
        next: &dyn Fn() -> Option<usize>,
        finished: &dyn Fn(),
    ) -> Result<Share, EvaluationError> {
        let mut environment = open();
        let mut memory = Memory::of(&self.policy).map_err(EvaluationError::Memory)?;
        let controller = memory
            .controller_with(&self.policy, self.isa)
            .map_err(EvaluationError::Memory)?;
        let sight = Sight::of(self.contract, &self.policy, environment.as_ref());
        let sight = sight.map_err(EvaluationError::Sight)?;
        let mut driver = Driver::new(controller, environment.as_mut(), sight);
        if self.setup.traced > 0 {
            driver.record(self.setup.pictures);
        }
        driver.set_observer(self.setup.observer);
        let (mut episodes, mut refused_at) = (Vec::new(), Vec::new());
        while let Some(place) = next() {
            let episode = (place % self.episodes as usize) as u32;
            let Some(assignment) = self.assignments.get(place / self.episodes as usize) else {
                break;
            };
            let task = self.task(assignment, episode);
            let run = match driver.run(&task) {
                Err(RolloutError::Step { step, .. }) if self.setup.stop_where_refused => {
                    refused_at.push(step);
                    driver.outcome(&task)
                }
                Err(RolloutError::Stopped) => break,
                other => other.map_err(|source| EvaluationError::Rollout {
                    instruction: assignment.instruction,
                    episode,
                    source,
                })?,
            };
            let trace = (episode < self.setup.traced).then(|| Trace {
                instruction: assignment.instruction,
                episode,
                sampling_seed: match task.decision {
                    Decision::Sample { seed, .. } => Some(seed),
                    Decision::Argmax => None,
                },
                noise_seed: match task.noise {
                    Noise::Seeded { seed } => Some(seed),
                    Noise::Zero => None,
                },
                commanded: task.plans.is_some(),
                continued: false,
                outcome: run.clone(),
                steps: driver.take_recording(),
            });
            episodes.push((place, run, trace));
            finished();
        }
        Ok(Share {
            episodes,
            refused_at,
            timing: driver.timing,
        })
    }

    fn task<'t>(&'t self, assignment: &'t Assignment, episode: u32) -> Task<'t> {
        let seed = EpisodeSeed {
            seed: self.seed,
            instruction: u64::from(assignment.instruction),
            episode: u64::from(episode),
        };
        let decision = match self.decision {
            Decision::Sample { temperature, .. } => Decision::Sample {
                temperature,
                seed: stream_seed(seed, DECISION_STREAM),
            },
            Decision::Argmax => Decision::Argmax,
        };
        let noise = match self.policy.contract().noise() {
            Noise::Seeded { .. } => Noise::Seeded {
                seed: stream_seed(seed, NOISE_STREAM),
            },
            Noise::Zero => Noise::Zero,
        };
        Task {
            instruction: assignment.instruction,
            words: self
                .setup
                .words
                .and_then(|book| book.of(assignment.instruction)),
            commanded: &assignment.commanded,
            max_steps: assignment.max_steps,
            seed,
            decision,
            noise,
            actor: self.actor,
            faults: self.setup.faults,
            plans: self
                .setup
                .plans
                .and_then(|book| book.of(assignment.instruction, episode)),
        }
    }
}

/// Seed of one of an episode's streams, such as the one that its plans are sampled from: the first draw of numpy's
/// `default_rng([seed, instruction, episode, stream])`, 53 bits.
pub(crate) fn stream_seed(seed: EpisodeSeed, stream: u64) -> u64 {
    let [run, instruction, episode] = seed.entropy();
    let unit = Stream::new(&[run, instruction, episode, stream]).unit();
    (unit * (1_u64 << 53) as f64) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_episode_samples_from_another_stream() {
        let seeds = (0..4).flat_map(|instruction| {
            (0..4).map(move |episode| EpisodeSeed {
                seed: 7,
                instruction,
                episode,
            })
        });
        let mut drawn: Vec<u64> = seeds
            .map(|seed| stream_seed(seed, DECISION_STREAM))
            .collect();
        assert_eq!(
            drawn[0],
            stream_seed(
                EpisodeSeed {
                    seed: 7,
                    instruction: 0,
                    episode: 0
                },
                DECISION_STREAM
            )
        );
        drawn.sort_unstable();
        drawn.dedup();
        assert_eq!(drawn.len(), 16);
    }

    #[test]
    fn noise_is_seeded_as_the_exporter_does() {
        // exporter/tests/test_reference.py has the same numbers.
        for ([seed, instruction, episode], known) in [
            ([0, 1, 2], 6_282_830_349_413_829),
            ([7, 100, 49], 5_255_917_235_266_557),
        ] {
            let seed = EpisodeSeed {
                seed,
                instruction,
                episode,
            };
            assert_eq!(stream_seed(seed, NOISE_STREAM), known);
        }
    }
}
