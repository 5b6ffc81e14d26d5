//! One control step: observation in, action out.

use lads_image::ExecError;
use lads_image::records::{self, Event};
use lads_kernels::assign;

use super::{Begun, Controller, NoiseStream, Selected, StepReport, clear_plain};
use crate::contract::{ChannelId, Role};
use crate::decision::margin;
use crate::errors::{InputError, RunError, StepError};
use crate::inputs::{self, Data};
use crate::run::{Counters, Draws, Run};
use crate::workspace::Workspace;

impl Controller<'_, '_> {
    /// Runs one control step of a policy with a single observation channel of floats: writes the
    /// action for an observation, both in the contract's units.
    pub fn step(
        &mut self,
        observation: &[f32],
        action: &mut [f32],
    ) -> Result<StepReport, StepError> {
        self.fits(action)?;
        let contract = self.policy.contract();
        let given = [(contract.only_observation()?, Data::F32(observation))];
        contract.check_only(observation)?;
        let report = self.advance(&given, None)?;
        assign(action, self.workspace.now.action);
        Ok(report)
    }

    /// Runs one control step of any policy: writes the action for the values of all observation
    /// channels, given in any order. Values for the noise channel,
    /// [`Policy::noise_len`](crate::Policy::noise_len) of them in the order in which they are used,
    /// take the place of the generator's.
    pub fn step_with(
        &mut self,
        inputs: &[(ChannelId, Data)],
        action: &mut [f32],
    ) -> Result<StepReport, StepError> {
        self.fits(action)?;
        let contract = self.policy.contract();
        let noise = inputs::check(contract, Role::Observation, inputs, self.policy.noise_len())?;
        let report = self.advance(inputs, noise)?;
        assign(action, self.workspace.now.action);
        Ok(report)
    }

    /// Tells the controller which action was executed since the last step, if it is not the one
    /// that the step returned; the next step sees it as the previous action, clipped to the
    /// contract's limits.
    pub fn executed(&mut self, action: &[f32]) -> Result<(), StepError> {
        self.fits(action)?;
        let contract = self.policy.contract();
        if let Some(index) = action.iter().position(|x| !x.is_finite()) {
            return Err(StepError::Input(InputError::NotFinite {
                channel: contract.action().id().0,
                index,
            }));
        }
        if !self.stepped {
            return Err(StepError::NothingExecuted);
        }
        let bounds = contract.action_bounds();
        assign(self.workspace.now.action, action);
        bounds.clamp(self.workspace.now.action);
        Ok(())
    }

    /// Runs a control step whose action stays in the state. The inputs were checked before.
    pub(crate) fn advance(
        &mut self,
        given: &[(ChannelId, Data)],
        noise: Option<&[f32]>,
    ) -> Result<StepReport, StepError> {
        if !self.workspace.fits(&self.policy) {
            return Err(StepError::Run(RunError::Program(ExecError::Span)));
        }
        let Begun { counters, restarts } = self.begin()?;
        let timestep = counters.timestep;
        let Workspace { now, next, .. } = &mut self.workspace;
        next.copy_from(now);
        if restarts {
            clear_plain(self.policy.tables(), next.plain);
        }
        let mut decider = self.decider.clone();
        let draws = match (noise, &self.noise) {
            (Some(values), _) => Draws::Given(values),
            (None, NoiseStream::Zero) => Draws::Zero,
            (None, NoiseStream::Seeded { normals, .. }) => Draws::Seeded(normals.clone()),
        };
        let mut run = Run::new(&self.policy, &mut self.workspace, given, counters);
        run.draws = draws;
        let mut fresh = false;
        for call in run.tables.due(Event::Step, timestep) {
            run.call(&call)?;
            if call.select != records::NONE {
                let scores = run.plain(call.select)?;
                let (index, lead) = (decider.pick(scores), margin(scores));
                run.counters.selected = index;
                run.counters.margin = lead;
                fresh = true;
            }
        }
        let Run {
            counters, draws, ..
        } = run;
        self.policy
            .contract()
            .action_bounds()
            .clamp(self.workspace.next.action);

        self.workspace.now.copy_from(&self.workspace.next);
        self.decider = decider;
        if let (Draws::Seeded(drawn), NoiseStream::Seeded { normals, .. }) =
            (draws, &mut self.noise)
        {
            *normals = drawn;
        }
        self.counters = Counters {
            timestep: self.following(timestep),
            ..counters
        };
        self.stepped = true;
        Ok(StepReport {
            timestep,
            selected: self.policy.sizes.scores.map(|_| Selected {
                index: counters.selected,
                margin: counters.margin,
                fresh,
            }),
        })
    }

    /// Returns the timestep after this one. In a context without end it goes back, before it would
    /// overflow, to one of the same phase.
    fn following(&self, timestep: u32) -> u32 {
        /// Timestep at which an unbounded context goes back: some 24 days at a kilohertz.
        const FAR: u32 = 1 << 31;
        let next = timestep.saturating_add(1);
        let period = self.policy.sizes.period;
        let back = self.policy.contract().context_steps().is_none()
            && next >= FAR
            && next.is_multiple_of(period);
        if back { period } else { next }
    }
}
