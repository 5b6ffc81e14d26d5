//! Contenders of a measurement, and the work that is measured.
//!
//! A [`Contender`] runs one policy. It is measured in blocks: a few calls one after the other, hot
//! or paced, of one kind of work, so that contenders can take turns and a change of the machine's
//! state affects them all.

use lads_core::{DType, Policy};
use lads_host::schedule;
use lads_image::Tables;

use crate::clock::{Pace, Ticker, now};
use crate::error::BenchError;

/// Kind of a measured call.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Kind {
    /// Action for a given index, such as that of a plan: the only part that runs in every control
    /// step.
    Act,
    /// A control step inside a period of the schedule; any control step of a policy without one.
    Ordinary,
    /// A control step that begins a period of the schedule: it also runs the periodic calls, such
    /// as picking a plan.
    Decision,
    /// A new instruction: its words go through the transformer.
    Instruct,
    /// Computation of the logits from the whole history at once, as in a plain export without a KV
    /// cache.
    Recompute,
}

impl Kind {
    /// All kinds, in the order of reports.
    pub const ALL: [Self; 5] = [
        Self::Act,
        Self::Ordinary,
        Self::Decision,
        Self::Instruct,
        Self::Recompute,
    ];

    /// Returns the name of the kind in tables and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Act => "act",
            Self::Ordinary => "ordinary",
            Self::Decision => "decision",
            Self::Instruct => "instruct",
            Self::Recompute => "recompute",
        }
    }
}

/// Work of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Work {
    /// Computation of the action for a given index.
    Act,
    /// Control steps of an episode, starting at this one. Contenders that cannot continue from one
    /// call to the next repeat the middle one.
    Steps {
        /// Number of the first control step, from 0.
        first: usize,
    },
    /// Setting the instruction, again and again.
    Instruct,
    /// Full recomputation at this control step.
    Recompute {
        /// Number of the control step, from 0.
        step: usize,
    },
}

/// A few consecutive calls that are measured together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Block {
    /// Work of each call.
    pub work: Work,
    /// Timing of the calls.
    pub pace: Pace,
    /// Number of recorded calls.
    pub calls: usize,
    /// Number of calls before the recorded ones, which bring the contender's own state into the
    /// caches that the pace leaves it.
    pub settle: usize,
}

impl Block {
    /// Returns the control step in the middle: the context of contenders that do not advance.
    pub fn middle(&self) -> usize {
        match self.work {
            Work::Steps { first } => first + self.calls / 2,
            Work::Recompute { step } => step,
            Work::Act | Work::Instruct => 0,
        }
    }
}

/// Measurement of one call, in nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sample {
    /// Kind of the call.
    pub kind: Kind,
    /// Number of the control step.
    pub step: usize,
    /// Time from the deadline to the wake-up.
    pub late: u64,
    /// Time from the wake-up to the result.
    pub took: u64,
}

/// Result of a contender in one control step.
#[derive(Debug, Clone, PartialEq)]
pub struct Computed {
    /// The index in force, if the policy selects one.
    pub selected: Option<u32>,
    /// The action, inside the contract's limits.
    pub action: Vec<f32>,
}

/// A recorded episode that all contenders replay.
#[derive(Debug, Clone)]
pub struct Episode {
    /// Number of the instruction; `None` for a policy that takes none.
    pub instruction: Option<u32>,
    /// Number of control steps after which the schedule repeats; 1 for a policy whose steps are
    /// alike.
    pub period: usize,
    /// Number of control steps that fit into the context; the number recorded if it is unbounded.
    pub context_steps: usize,
    /// Observations; a longer episode starts with the first again. They are empty for a policy that
    /// has more than one channel of floats.
    pub observations: Vec<Vec<f32>>,
    /// Results of the policy, by the runtime that recorded it.
    pub recorded: Vec<Computed>,
    /// Limits of each action element.
    pub limits: Vec<(f32, f32)>,
    /// Names and shapes of the image channels, a frame of each of which every control step reads.
    pub images: Vec<String>,
}

impl Episode {
    /// Reads the golden episode of a policy.
    pub fn of(policy: &Policy<'_>) -> Result<Self, BenchError> {
        let contract = policy.contract();
        let golden = policy.golden().ok_or_else(|| {
            BenchError::new(
                "the policy",
                "it carries no golden episode, so there are no observations to measure with",
                "export the bundle with one",
            )
        })?;
        let recorded = golden.steps().map(|step| Computed {
            selected: step.selected,
            action: step.action.to_vec(),
        });
        let period = Tables::new(policy.image()).map_or(1, |tables| schedule::period(&tables));
        Ok(Self {
            instruction: golden.instruction(),
            period: period as usize,
            context_steps: contract.context_steps().unwrap_or(golden.len()),
            observations: golden
                .steps()
                .map(|step| step.observation().to_vec())
                .collect(),
            recorded: recorded.collect(),
            limits: contract
                .action_limits()
                .map(|limits| (limits.min, limits.max))
                .collect(),
            images: contract
                .observations()
                .filter(|channel| channel.dtype() == DType::U8)
                .map(|channel| {
                    let sides = channel.shape().iter().map(u32::to_string);
                    format!("{} {}", channel.name(), sides.collect::<Vec<_>>().join("x"))
                })
                .collect(),
        })
    }

    /// Returns the observation of a control step.
    pub fn observation(&self, step: usize) -> &[f32] {
        let index = step % self.observations.len().max(1);
        self.observations.get(index).map_or(&[], Vec::as_slice)
    }

    /// Returns whether a control step begins a period of the schedule.
    pub fn decides(&self, step: usize) -> bool {
        self.period > 1 && step.is_multiple_of(self.period)
    }

    /// Returns the kind of a control step: [`Kind::Decision`] or [`Kind::Ordinary`].
    pub fn kind(&self, step: usize) -> Kind {
        if self.decides(step) {
            Kind::Decision
        } else {
            Kind::Ordinary
        }
    }

    /// Returns the first control step of a block of `calls` around the one with `tokens` in its
    /// context, of which `words` are the instruction's.
    pub fn first_around(&self, tokens: usize, words: usize, calls: usize) -> usize {
        // Step t finds the words, s_0 and two tokens for each of the t - 1 steps after it.
        let middle = tokens.saturating_sub(words).div_ceil(2);
        let last = self.context_steps.saturating_sub(calls);
        middle.saturating_sub(calls / 2).min(last)
    }
}

/// A runtime or program that can run the policy.
pub trait Contender {
    /// Returns a short name, unique in a run.
    fn name(&self) -> &str;

    /// Returns version and settings, for the report.
    fn detail(&self) -> String;

    /// Runs the first `steps` control steps of the episode, untimed: the results are compared
    /// before anything is measured.
    fn replay(&mut self, steps: usize) -> Result<Vec<Computed>, BenchError>;

    /// Returns whether the contender can do a block's work at all.
    fn offers(&self, work: Work) -> bool;

    /// Measures one block.
    fn block(&mut self, block: &Block, samples: &mut Vec<Sample>) -> Result<(), BenchError>;
}

/// Makes the calls of a block and records all but the first `settle`. `call` gets the number of the
/// call and returns its kind and step.
pub fn measure<E>(
    block: &Block,
    samples: &mut Vec<Sample>,
    mut call: impl FnMut(usize) -> Result<(Kind, usize), E>,
) -> Result<(), E> {
    let mut ticker = Ticker::start(block.pace);
    samples.reserve(block.calls);
    for number in 0..block.settle + block.calls {
        let late = ticker.wait();
        let start = now();
        let (kind, step) = call(number)?;
        let took = now() - start;
        if number >= block.settle {
            samples.push(Sample {
                kind,
                step,
                late,
                took,
            });
        }
    }
    Ok(())
}

/// Compares the results of two contenders: indices in force equal, actions within `tolerance`.
/// Returns the largest difference of an action.
pub fn compare(
    name: &str,
    got: &[Computed],
    wanted: &[Computed],
    tolerance: f32,
) -> Result<f32, BenchError> {
    let remedy = "do not trust its speed; export the bundle again or leave the contender out";
    if got.len() != wanted.len() || got.is_empty() {
        let wrong = format!(
            "it computed {} control steps, not {}",
            got.len(),
            wanted.len()
        );
        return Err(BenchError::new(name, wrong, remedy));
    }
    let mut largest = 0.0_f32;
    for (step, (got, wanted)) in got.iter().zip(wanted).enumerate() {
        if got.selected != wanted.selected {
            let index = |of: &Computed| of.selected.map_or("none".to_owned(), |i| i.to_string());
            let wrong = format!("index {} in step {step}, not {}", index(got), index(wanted));
            return Err(BenchError::new(name, wrong, remedy));
        }
        let differences = got
            .action
            .iter()
            .zip(&wanted.action)
            .map(|(a, b)| (a - b).abs());
        let difference = differences.fold(
            0.0,
            |most: f32, x| if x > most || x.is_nan() { x } else { most },
        );
        if got.action.len() != wanted.action.len() || difference > tolerance || difference.is_nan()
        {
            let wrong =
                format!("the action of step {step} differs by {difference}, more than {tolerance}");
            return Err(BenchError::new(name, wrong, remedy));
        }
        largest = largest.max(difference);
    }
    Ok(largest)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn computed(selected: u32, action: f32) -> Computed {
        Computed {
            selected: Some(selected),
            action: vec![action],
        }
    }

    #[test]
    fn other_indices_and_other_actions_are_told() {
        let wanted = [computed(3, 0.5), computed(4, 0.25)];
        let compared =
            |got: &[Computed]| compare("x", got, &wanted, 1e-3).map_err(|e| e.to_string());
        assert!(compared(&wanted).is_ok_and(|largest| largest == 0.0));
        assert!(compared(&[computed(3, 0.5), computed(4, 0.2502)]).is_ok_and(|x| x > 1e-4));
        for wrong in [
            vec![],
            vec![computed(3, 0.5)],
            vec![computed(3, 0.5), computed(3, 0.25)],
            vec![computed(3, 0.5), computed(4, 0.2)],
            vec![computed(3, f32::NAN), computed(4, 0.25)],
        ] {
            assert!(compared(&wrong).is_err(), "{wrong:?}");
        }
    }
}
