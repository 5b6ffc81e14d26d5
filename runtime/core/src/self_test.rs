//! The self-test: the policy's recorded episode, replayed on the target.

use core::error::Error;
use core::fmt;

use crate::contract::Decision;
use crate::controller::{Controller, Instruction};
use crate::decision::PlanIndex;
use crate::errors::{InstructionError, StepError};

/// The hash of nothing, and the factor, of FNV-1a with 32 bits.
const FNV_OFFSET: u32 = 0x811c_9dc5;
const FNV_PRIME: u32 = 0x0100_0193;

/// What a self-test that passed has measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SelfTest {
    /// Control steps replayed.
    pub steps: u32,
    /// Largest absolute difference of an action element.
    pub largest_error: f32,
    /// FNV-1a, of 32 bits, over the bits of all actions, as little-endian bytes: two targets with the same digest computed the same
    /// bits.
    pub digest: u32,
}

/// Why a self-test failed; steps count from 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SelfTestError {
    /// The image holds no recorded episode.
    NoGolden,
    /// The instruction was refused.
    Instruction(InstructionError),
    /// A step was refused.
    Step {
        /// Which one.
        step: u32,
        /// Why.
        error: StepError,
    },
    /// The first step with another plan than recorded.
    Plan {
        /// Which one.
        step: u32,
        /// Recorded plan.
        expected: PlanIndex,
        /// Plan on this target.
        got: PlanIndex,
    },
    /// The first step with an action further from the recorded one than the tolerance.
    Action {
        /// Which one.
        step: u32,
        /// Element of the action.
        index: u32,
        /// Recorded value.
        expected: f32,
        /// Value on this target.
        got: f32,
    },
}

impl Controller<'_, '_> {
    /// Replays the recorded episode, open loop on its observations and with argmax, and compares plans and actions. Whatever
    /// the outcome, the controller is afterwards without an instruction, and sampling starts from its seed.
    pub fn self_test(&mut self) -> Result<SelfTest, SelfTestError> {
        let rule = self.decision();
        self.set_decision(Decision::Argmax);
        let outcome = self.replay();
        self.renew(rule);
        outcome
    }

    fn replay(&mut self) -> Result<SelfTest, SelfTestError> {
        let golden = self.policy().golden().ok_or(SelfTestError::NoGolden)?;
        let instruction = Instruction::Id(golden.instruction());
        self.set_instruction(instruction)
            .map_err(SelfTestError::Instruction)?;
        let (mut largest_error, mut digest) = (0.0_f32, FNV_OFFSET);
        for (step, (observation, plan, action)) in (0_u32..).zip(golden.steps()) {
            let report = self
                .advance(observation)
                .map_err(|error| SelfTestError::Step { step, error })?;
            if report.plan.0 != plan {
                return Err(SelfTestError::Plan {
                    step,
                    expected: PlanIndex(plan),
                    got: report.plan,
                });
            }
            for (index, (&expected, &got)) in (0_u32..).zip(action.iter().zip(self.last_action())) {
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
                largest_error = largest_error.max(difference);
                for byte in got.to_le_bytes() {
                    digest = (digest ^ u32::from(byte)).wrapping_mul(FNV_PRIME);
                }
            }
        }
        Ok(SelfTest {
            steps: golden.len() as u32,
            largest_error,
            digest,
        })
    }
}

impl fmt::Display for SelfTestError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::NoGolden => f.write_str("the policy holds no recorded episode"),
            Self::Instruction(error) => write!(f, "the recorded instruction was refused: {error}"),
            Self::Step { step, error } => write!(f, "step {step} was refused: {error}"),
            Self::Plan {
                step,
                expected,
                got,
            } => write!(f, "step {step} chose plan {got}, recorded is {expected}"),
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
