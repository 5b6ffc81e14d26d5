//! The self-test: the policy's recorded episode, replayed on the target.

use core::error::Error;
use core::fmt;

use crate::contract::{Decision, Noise, Role};
use crate::controller::{Controller, Instruction};
use crate::errors::{InstructionError, StepError};
use crate::golden::Golden;
use crate::inputs::{self, Given};

/// Initial value, and the factor, of the 32-bit FNV-1a hash.
const FNV_OFFSET: u32 = 0x811c_9dc5;
const FNV_PRIME: u32 = 0x0100_0193;

/// Measurements of a self-test that passed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SelfTest {
    /// Number of control steps replayed.
    pub steps: u32,
    /// Largest absolute difference of an action element.
    pub largest_error: f32,
    /// FNV-1a, of 32 bits, over the bits of all actions, as little-endian bytes: two targets with the same digest computed the same
    /// bits.
    pub digest: u32,
}

/// Reason why a self-test failed; steps count from 0.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum SelfTestError {
    /// The image holds no recorded episode.
    NoGolden,
    /// The instruction was refused.
    Instruction(InstructionError),
    /// A step was refused.
    Step {
        /// Number of the step.
        step: u32,
        /// Error of the step.
        error: StepError,
    },
    /// The index in force differs from the recorded one; reports the first such step.
    Selected {
        /// Number of the step.
        step: u32,
        /// Index in the recorded episode.
        expected: u32,
        /// Index on this target.
        got: u32,
    },
    /// An action differs from the recorded one by more than the tolerance; reports the first such
    /// step.
    Action {
        /// Number of the step.
        step: u32,
        /// Element of the action.
        index: u32,
        /// Value in the recorded episode.
        expected: f32,
        /// Value on this target.
        got: f32,
    },
}

impl Controller<'_, '_> {
    /// Replays the recorded episode, open loop on its observations and noise and with argmax, and
    /// compares the indices in force and the actions. Afterwards, whatever the outcome, the
    /// controller has no instruction, and sampling and noise start from their seeds.
    pub fn self_test(&mut self) -> Result<SelfTest, SelfTestError> {
        let (rule, noise) = (self.decision(), self.noise());
        self.renew(Decision::Argmax, Noise::Zero);
        let outcome = self.replay();
        self.renew(rule, noise);
        self.set_tested(outcome.is_ok());
        outcome
    }

    fn replay(&mut self) -> Result<SelfTest, SelfTestError> {
        let golden = self.policy().golden().ok_or(SelfTestError::NoGolden)?;
        if let Some(id) = golden.instruction() {
            self.set_instruction(Instruction::Id(id))
                .map_err(SelfTestError::Instruction)?;
        }
        let mut measured = SelfTest {
            steps: golden.len() as u32,
            largest_error: 0.0,
            digest: FNV_OFFSET,
        };
        for step in 0..measured.steps {
            self.replay_step(&golden, step, &mut measured)?;
        }
        Ok(measured)
    }

    /// Replays one step of the recorded episode. Out of line, so that its inputs do not add to the
    /// stack of the step itself.
    #[inline(never)]
    fn replay_step(
        &mut self,
        golden: &Golden,
        step: u32,
        measured: &mut SelfTest,
    ) -> Result<(), SelfTestError> {
        let refused = |error| SelfTestError::Step { step, error };
        let i = step as usize;
        let mut given = Given::default();
        // A checked episode has all of its steps.
        let (Some(()), Some(noise), Some(action)) = (
            golden.observe(i, &mut given),
            golden.noise(i),
            golden.action(i),
        ) else {
            return Ok(());
        };
        let given = given.all();
        inputs::check(self.policy().contract(), Role::Observation, given, 0)
            .map_err(|error| refused(StepError::Input(error)))?;
        let noise = (!noise.is_empty()).then_some(noise);
        let report = self.advance(given, noise).map_err(refused)?;
        let selected = report.selected.map(|selected| selected.index);
        if let (Some(expected), Some(got)) = (golden.selected(i), selected)
            && expected != got
        {
            return Err(SelfTestError::Selected {
                step,
                expected,
                got,
            });
        }
        let both = action.iter().zip(self.last_action());
        for (index, (&expected, &got)) in (0_u32..).zip(both) {
            let difference = (expected - got).abs();
            // A recorded value that is not a number compares as different.
            if difference > golden.tolerance() || difference.is_nan() {
                return Err(SelfTestError::Action {
                    step,
                    index,
                    expected,
                    got,
                });
            }
            measured.largest_error = measured.largest_error.max(difference);
            for byte in got.to_le_bytes() {
                measured.digest = (measured.digest ^ u32::from(byte)).wrapping_mul(FNV_PRIME);
            }
        }
        Ok(())
    }
}

impl fmt::Display for SelfTestError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::NoGolden => f.write_str("the policy holds no recorded episode"),
            Self::Instruction(error) => write!(f, "the recorded instruction was refused: {error}"),
            Self::Step { step, error } => write!(f, "step {step} was refused: {error}"),
            Self::Selected {
                step,
                expected,
                got,
            } => write!(
                f,
                "step {step} selected index {got}, recorded is {expected}"
            ),
            Self::Action {
                step,
                index,
                expected,
                got,
            } => {
                write!(
                    f,
                    "step {step}, action element {index} is {got}, recorded is {expected}"
                )
            }
        }
    }
}

impl Error for SelfTestError {}
