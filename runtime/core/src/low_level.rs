//! The low level: from the index of a plan to its latent plan, and from an observation and the latent plan to an action.
//!
//! Both results go to a bank that does not count yet, so a failure leaves the episode as it was. What can fail: a program
//! whose spans are those of another policy, a result that is not finite ([`Fault`]).

use lads_kernels::assign;

use crate::decision::PlanIndex;
use crate::errors::{ActError, StepError};
use crate::exec::{ExecError, Inputs, Machine};
use crate::image::ProgramKind;
use crate::op::Port;
use crate::policy::Policy;
use crate::workspace::Bank;

/// Why a program gave nothing that may be used.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Fault {
    /// It failed.
    Program(ExecError),
    /// Its result is not finite, or not as long as it should be.
    NotFinite,
}

impl From<Fault> for StepError {
    fn from(fault: Fault) -> Self {
        match fault {
            Fault::Program(error) => Self::Program(error),
            Fault::NotFinite => Self::NotFiniteResult,
        }
    }
}

impl From<Fault> for ActError {
    fn from(fault: Fault) -> Self {
        match fault {
            Fault::Program(error) => Self::Program(error),
            Fault::NotFinite => Self::NotFiniteResult,
        }
    }
}

/// Puts the latent plan with this index into the bank.
pub(crate) fn look_up(
    machine: &mut Machine,
    policy: &Policy,
    plan: PlanIndex,
    bank: &mut Bank,
) -> Result<(), Fault> {
    let program = policy.program(ProgramKind::Lookup);
    let inputs = Inputs {
        plan_index: plan.0,
        ..Inputs::default()
    };
    machine
        .run(program, policy.weights(), 0, &inputs)
        .map_err(Fault::Program)?;
    take_finite(machine.output(program, Port::Plan), bank.plan)
}

/// Puts the action for an observation and the bank's latent plan into the bank, clipped to the contract's limits.
pub(crate) fn act(
    machine: &mut Machine,
    policy: &Policy,
    observation: &[f32],
    plan: PlanIndex,
    bank: &mut Bank,
) -> Result<(), Fault> {
    let program = policy.program(ProgramKind::Act);
    let inputs = Inputs {
        observation,
        plan: bank.plan,
        plan_index: plan.0,
        ..Inputs::default()
    };
    machine
        .run(program, policy.weights(), 0, &inputs)
        .map_err(Fault::Program)?;
    take_finite(machine.output(program, Port::Action), bank.action)?;
    let limits = policy.contract().action_limits();
    for (action, limits) in bank.action.iter_mut().zip(limits) {
        *action = limits.clamp(*action);
    }
    Ok(())
}

/// Copies what a program gave, if all of it is finite.
pub(crate) fn take_finite(from: &[f32], to: &mut [f32]) -> Result<(), Fault> {
    if from.len() != to.len() || !from.iter().all(|x| x.is_finite()) {
        return Err(Fault::NotFinite);
    }
    assign(to, from);
    Ok(())
}
