//! The recorded episode that a policy replays to test itself on its target.

use crate::codec::{Field, Reader};
use crate::contract::Contract;
use crate::image::GoldenRecord;

/// A checked view on the recorded episode: observations, the plan in force and the action of each control step.
#[derive(Debug, Clone, Copy)]
pub struct Golden<'a> {
    record: GoldenRecord,
    observations: &'a [f32],
    plans: &'a [u32],
    actions: &'a [f32],
    observation_len: usize,
    action_len: usize,
}

impl<'a> Golden<'a> {
    /// Checks the golden section; `None` when it contradicts the contract.
    pub(crate) fn new_checked(section: &'a [u32], contract: &Contract<'a>) -> Option<Self> {
        let (record, rest) = section.split_at_checked(GoldenRecord::WORDS)?;
        let record = GoldenRecord::take(&mut Reader::new(record))?;
        let steps = record.steps as usize;
        let (observation_len, action_len) = (contract.observation_len(), contract.action_len());
        let (observations, rest) = rest.split_at_checked(steps.checked_mul(observation_len)?)?;
        let (plans, actions) = rest.split_at_checked(steps)?;
        let known = (record.instruction as usize) < contract.instruction_count();
        let tolerance = record.tolerance.is_finite() && record.tolerance >= 0.0;
        let complete = steps > 0 && Some(actions.len()) == steps.checked_mul(action_len);
        (known && tolerance && complete).then_some(Self {
            record,
            observations: bytemuck::try_cast_slice(observations).ok()?,
            plans,
            actions: bytemuck::try_cast_slice(actions).ok()?,
            observation_len,
            action_len,
        })
    }

    /// Number of the instruction that was followed.
    pub fn instruction(&self) -> u32 {
        self.record.instruction
    }

    /// Control steps.
    pub fn len(&self) -> usize {
        self.plans.len()
    }

    /// Never true: an episode has at least one step.
    pub fn is_empty(&self) -> bool {
        self.plans.is_empty()
    }

    /// Largest absolute difference of an action that the self-test accepts.
    pub fn tolerance(&self) -> f32 {
        self.record.tolerance
    }

    /// For each control step its observation, the plan in force and the action.
    pub fn steps(&self) -> impl Iterator<Item = (&'a [f32], u32, &'a [f32])> + use<'a> {
        let observations = self.observations.chunks_exact(self.observation_len.max(1));
        let actions = self.actions.chunks_exact(self.action_len.max(1));
        observations
            .zip(self.plans)
            .zip(actions)
            .map(|((observation, &plan), action)| (observation, plan, action))
    }
}
