//! The control loop of a policy: observation in, action out, once every control period.
//!
//! At control step `t` the tokens of the previous action and the observation are appended to the KV cache; when `t` is a
//! multiple of the horizon the same step also evaluates the logits and picks the plan; then the low level maps observation and
//! plan to an action.
//!
//! ```text
//! t = 0        start:        [s_0]          → logits        plan = decide(logits)
//! t % H == 0   step_decide:  [a_{t-1}, s_t] → logits        plan = decide(logits)
//! otherwise    step_record:  [a_{t-1}, s_t]
//! every t      act: (s_t, plan) → a_t, clipped to the contract's limits
//! ```
//!
//! Invariants:
//! - A call that returns an error leaves the controller as it was: what a step computes goes to a second bank and to cache
//!   rows that do not count yet, and is taken over at the end. (One exception: see [`Controller::set_instruction`].)
//! - An action that leaves the controller is finite and inside the contract's limits.
//! - Nothing is allocated, no call blocks, and the work of a step is bounded by the longest context.

use lads_kernels::{Isa, assign};

use crate::contract::{Decision, Interval};
use crate::decision::{Decider, PlanIndex, margin};
use crate::errors::{ActError, EncodeError, InstructionError, StepError};
use crate::exec::{ExecError, Inputs};
use crate::image::{Beyond, ProgramKind};
use crate::low_level::{self, take_finite};
use crate::op::Port;
use crate::policy::Policy;
use crate::workspace::Workspace;

/// What a policy is told to do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Instruction<'w> {
    /// Number of an instruction in the contract.
    Id(u32),
    /// Word embeddings, `[n, word_dim]` with `n` from 1 to the contract's `words_len`.
    ///
    /// Any are followed, of nonsense too: [`similarity::nearest`](crate::similarity::nearest) says what they are like before that.
    Words(&'w [f32]),
}

/// What happened in a control step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// Control steps since the context began: 0 in the first step after an instruction, a reset or a restart of the context.
    pub timestep: u32,
    /// The plan in force.
    pub plan: PlanIndex,
    /// Whether this step decided it.
    pub decided: bool,
    /// The largest logit of the last decision minus the second largest; infinite with a codebook of one.
    pub margin: f32,
}

/// The counters that a step advances.
#[derive(Debug, Clone, Copy)]
struct Clock {
    /// Control steps since the context began.
    timestep: u32,
    /// Tokens in the KV cache.
    past: usize,
    /// Plan in force.
    plan: PlanIndex,
    /// Of the last decision.
    margin: f32,
}

/// A policy at work in memory that the caller lent.
#[derive(Debug)]
pub struct Controller<'a, 'm> {
    policy: Policy<'a>,
    workspace: Workspace<'m>,
    decider: Decider,
    clock: Clock,
    /// Words of the instruction in the cache; 0 when there is none.
    words: usize,
}

impl<'a, 'm> Controller<'a, 'm> {
    /// A controller with the contract's decision rule and no instruction yet, on the widest instructions that this CPU offers.
    /// The workspace has to be one made for this policy: with that of another policy, calls fail with [`ExecError::Span`].
    pub fn new(policy: Policy<'a>, workspace: Workspace<'m>) -> Self {
        Self::with_isa(policy, workspace, Isa::detect())
    }

    /// The same on chosen instructions; the results have the same bits on all of them. [`Isa::portable`] runs the same machine
    /// code on every CPU of a target.
    pub fn with_isa(policy: Policy<'a>, mut workspace: Workspace<'m>, isa: Isa) -> Self {
        workspace.machine.isa = isa;
        let decider = Decider::new(policy.contract().decision());
        let clock = Clock {
            timestep: 0,
            past: 0,
            plan: PlanIndex(0),
            margin: 0.0,
        };
        Self {
            policy,
            workspace,
            decider,
            clock,
            words: 0,
        }
    }

    /// The policy at work.
    pub fn policy(&self) -> &Policy<'a> {
        &self.policy
    }

    /// The instructions that it runs on.
    pub fn isa(&self) -> Isa {
        self.workspace.machine.isa
    }

    /// Changes how plans are picked, from the next decision on. Sampling starts again from the seed.
    pub fn set_decision(&mut self, decision: Decision) {
        self.decider = Decider::new(decision);
    }

    /// How plans are picked.
    pub fn decision(&self) -> Decision {
        self.decider.rule()
    }

    /// Follows an instruction from the next step on: a new episode, `t = 0`. Sampling goes on where it was.
    ///
    /// A refused instruction changes nothing. [`InstructionError::Program`], which a sound image never causes, leaves the
    /// controller without an instruction.
    pub fn set_instruction(&mut self, instruction: Instruction) -> Result<(), InstructionError> {
        let contract = self.policy.contract();
        let words = match instruction {
            Instruction::Id(id) => {
                let count = contract.instruction_count() as u32;
                contract
                    .instruction(id as usize)
                    .ok_or(InstructionError::Unknown { id, count })?
                    .words
            }
            Instruction::Words(words) => words,
        };
        let (dim, most) = (contract.word_dim(), contract.words_len());
        let count = words.len().checked_div(dim).unwrap_or(0);
        if !words.len().is_multiple_of(dim) {
            return Err(InstructionError::Length {
                got: words.len(),
                word_dim: dim,
            });
        }
        if count == 0 || count > most {
            return Err(InstructionError::Words { got: count, most });
        }
        if let Some(index) = words.iter().position(|x| !x.is_finite()) {
            return Err(InstructionError::NotFinite { index });
        }
        self.words = 0;
        let inputs = Inputs {
            words,
            ..Inputs::default()
        };
        self.run(ProgramKind::Instruct, 0, &inputs)
            .map_err(InstructionError::Program)?;
        self.words = count;
        self.reset();
        Ok(())
    }

    /// Brings code, weights and KV cache into the caches, so that the next step, whichever kind it is, is as fast as the ones
    /// after it: for right before the first step, or after a pause. Costs about two control steps and changes nothing.
    pub fn warm(&mut self) {
        // Without an instruction or with a full context there may be nothing to come, but code and weights are the same.
        let (timestep, past) = self
            .begin()
            .map_or((1, 0), |clock| (clock.timestep, clock.past));
        let high = match timestep {
            0 => [ProgramKind::Start, ProgramKind::StepRecord],
            _ => [ProgramKind::StepDecide, ProgramKind::StepRecord],
        };
        let inputs = Inputs {
            timestep,
            ..Inputs::default()
        };
        // What these append lies behind the rows that count, where the next step writes too; plan, action and logits are only
        // taken over by a step. A program that fails does so again in the step, which reports it.
        for kind in high {
            let _ = self.run(kind, past, &inputs);
        }
        for kind in [ProgramKind::Lookup, ProgramKind::Act] {
            let _ = self.run(kind, 0, &inputs);
        }
    }

    /// Starts a new episode with the same instruction: `t = 0`, the words stay in the context. Sampling goes on where it was.
    pub fn reset(&mut self) {
        self.clock = Clock {
            timestep: 0,
            past: self.words,
            plan: PlanIndex(0),
            margin: 0.0,
        };
    }

    /// One control step: writes the action for an observation, both in the contract's units.
    pub fn step(
        &mut self,
        observation: &[f32],
        action: &mut [f32],
    ) -> Result<StepReport, StepError> {
        let needed = self.policy.contract().action_len();
        if action.len() != needed {
            return Err(StepError::ActionLength {
                got: action.len(),
                needed,
            });
        }
        let report = self.advance(observation)?;
        assign(action, self.workspace.now.action);
        Ok(report)
    }

    /// Tells the controller what was really executed since the last step, where that is not the action it returned; the next
    /// step puts it into the context, clipped to the contract's limits.
    pub fn executed(&mut self, action: &[f32]) -> Result<(), StepError> {
        let contract = self.policy.contract();
        let needed = contract.action_len();
        if action.len() != needed {
            return Err(StepError::ActionLength {
                got: action.len(),
                needed,
            });
        }
        if let Some(index) = action.iter().position(|x| !x.is_finite()) {
            return Err(StepError::NotFinite { index });
        }
        if self.clock.timestep == 0 {
            return Err(StepError::NothingExecuted);
        }
        for ((to, &from), limits) in self
            .workspace
            .now
            .action
            .iter_mut()
            .zip(action)
            .zip(contract.action_limits())
        {
            *to = limits.clamp(from);
        }
        Ok(())
    }

    /// The logits of the last decision, one per codebook entry; zeros before the first.
    pub fn logits(&self) -> &[f32] {
        self.workspace.now.logits
    }

    /// The action of the last step, or what [`executed`](Self::executed) said.
    pub(crate) fn last_action(&self) -> &[f32] {
        self.workspace.now.action
    }

    /// The low level alone: the action for an observation and a plan, clipped to the contract's limits. Changes nothing in the
    /// episode under way, and needs no instruction.
    pub fn act(
        &mut self,
        observation: &[f32],
        plan: PlanIndex,
        action: &mut [f32],
    ) -> Result<(), ActError> {
        let contract = self.policy.contract();
        for (got, needed) in [
            (observation.len(), contract.observation_len()),
            (action.len(), contract.action_len()),
        ] {
            if got != needed {
                return Err(ActError::Length { got, needed });
            }
        }
        let size = contract.codebook_len() as u32;
        if plan.0 >= size {
            return Err(ActError::Plan { got: plan.0, size });
        }
        if let Some(index) = observation.iter().position(|x| !x.is_finite()) {
            return Err(ActError::NotFinite { index });
        }
        if self.workspace.bank_lens() != self.policy.bank_lens() {
            return Err(ActError::Program(ExecError::Span));
        }
        // The second bank holds nothing between two steps.
        let Workspace { machine, next, .. } = &mut self.workspace;
        low_level::look_up(machine, &self.policy, plan, next)?;
        low_level::act(machine, &self.policy, observation, plan, next)?;
        assign(action, next.action);
        Ok(())
    }

    /// The plan that one horizon of a demonstration follows: `observations` is `[H, O]`, `actions` is `[H, A]`. Changes nothing
    /// in the episode under way.
    pub fn encode(
        &mut self,
        observations: &[f32],
        actions: &[f32],
    ) -> Result<PlanIndex, EncodeError> {
        let contract = self.policy.contract();
        let program = *self.policy.program(ProgramKind::Encode);
        if program.is_empty() {
            return Err(EncodeError::NoEncoder);
        }
        let lens = [contract.observation_len(), contract.action_len()]
            .map(|len| len.saturating_mul(contract.horizon()));
        for (got, needed) in [observations.len(), actions.len()].into_iter().zip(lens) {
            if got != needed {
                return Err(EncodeError::Length { got, needed });
            }
        }
        if !observations.iter().chain(actions).all(|x| x.is_finite()) {
            return Err(EncodeError::NotFinite);
        }
        let inputs = Inputs {
            observation: observations,
            action: actions,
            ..Inputs::default()
        };
        self.run(ProgramKind::Encode, 0, &inputs)
            .map_err(EncodeError::Program)?;
        let index = self.workspace.machine.output_int(&program, Port::PlanIndex);
        Ok(PlanIndex(index.unwrap_or(0)))
    }

    /// A controller as [`new`](Self::new) made it, but for the decision rule.
    pub(crate) fn renew(&mut self, rule: Decision) {
        self.words = 0;
        self.reset();
        self.set_decision(rule);
        self.workspace.now.logits.fill(0.0);
    }

    /// A control step that leaves its action in the state.
    pub(crate) fn advance(&mut self, observation: &[f32]) -> Result<StepReport, StepError> {
        self.check(observation)?;
        if self.workspace.bank_lens() != self.policy.bank_lens() {
            return Err(StepError::Program(ExecError::Span));
        }
        let clock = self.begin()?;
        let decides = clock
            .timestep
            .is_multiple_of(self.policy.contract().horizon() as u32);
        let program = match (clock.timestep, decides) {
            (0, _) => ProgramKind::Start,
            (_, true) => ProgramKind::StepDecide,
            (_, false) => ProgramKind::StepRecord,
        };
        let Workspace { machine, now, next } = &mut self.workspace;
        let (policy, weights) = (&self.policy, self.policy.weights());
        next.copy_from(now);
        let mut decider = self.decider.clone();
        let (mut plan, mut plan_margin) = (clock.plan, clock.margin);

        let inputs = Inputs {
            observation,
            action: now.action,
            timestep: clock.timestep,
            ..Inputs::default()
        };
        let high = policy.program(program);
        machine
            .run(high, weights, clock.past, &inputs)
            .map_err(StepError::Program)?;
        if decides {
            take_finite(machine.output(high, Port::Logits), next.logits)?;
            plan = decider.pick(next.logits);
            plan_margin = margin(next.logits);
            low_level::look_up(machine, policy, plan, next)?;
        }
        low_level::act(machine, policy, observation, plan, next)?;

        now.copy_from(next);
        self.decider = decider;
        let past = clock.past.saturating_add(high.tokens());
        self.clock = Clock {
            timestep: clock.timestep.saturating_add(1),
            past,
            plan,
            margin: plan_margin,
        };
        Ok(StepReport {
            timestep: clock.timestep,
            plan,
            decided: decides,
            margin: plan_margin,
        })
    }

    /// Where the coming step starts: a full context restarts behind the words, or refuses.
    fn begin(&self) -> Result<Clock, StepError> {
        if self.words == 0 {
            return Err(StepError::NoInstruction);
        }
        let contract = self.policy.contract();
        let steps = contract.context_steps();
        if (self.clock.timestep as usize) < steps {
            return Ok(self.clock);
        }
        match contract.beyond() {
            Beyond::Restart => Ok(Clock {
                timestep: 0,
                past: self.words,
                ..self.clock
            }),
            Beyond::Refuse => Err(StepError::ContextFull { steps }),
        }
    }

    fn check(&self, observation: &[f32]) -> Result<(), StepError> {
        let contract = self.policy.contract();
        let needed = contract.observation_len();
        if observation.len() != needed {
            return Err(StepError::ObservationLength {
                got: observation.len(),
                needed,
            });
        }
        let limits = contract.observation_limits();
        for (index, (&value, Interval { min, max })) in observation.iter().zip(limits).enumerate() {
            if !value.is_finite() {
                return Err(StepError::NotFinite { index });
            }
            if value < min || value > max {
                return Err(StepError::OutOfLimits {
                    index,
                    value,
                    min,
                    max,
                });
            }
        }
        Ok(())
    }

    fn run(&mut self, kind: ProgramKind, past: usize, inputs: &Inputs) -> Result<(), ExecError> {
        self.workspace.machine.run(
            self.policy.program(kind),
            self.policy.weights(),
            past,
            inputs,
        )
    }
}
