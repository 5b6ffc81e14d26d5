//! The control loop of a policy: observations in, action out, once every control period.
//!
//! What a step does is written in the image: its schedule says which programs run at which timestep, how often, what they clear
//! and what is selected from their scores. For LADS, with plans that are held for `H` steps, it reads
//!
//! ```text
//! t = 0        start:        [s_0]          -> scores, select
//! t % H == 0   step_decide:  [a_{t-1}, s_t] -> scores, select
//! otherwise    step_record:  [a_{t-1}, s_t]
//! t % H == 0   lookup:       index -> plan
//! every t      act:          (s_t, plan) -> a_t
//! ```
//!
//! Invariants:
//! - A call that returns an error leaves the controller as it was: what a step computes goes to a second bank and to rows that do
//!   not count yet, and is taken over at the end. (One exception: see [`Controller::set_instruction`].)
//! - An action that leaves the controller is finite and inside the contract's limits.
//! - Nothing is allocated, no call blocks, and the work of a step is bounded by what the image states.

use lads_image::records::{self, Event, MAX_ROW_STATES, Scope, StateKind};
use lads_image::{ExecError, Tables};
use lads_kernels::{Isa, assign};

use crate::contract::{Beyond, ChannelId, Contract, DType, Decision, Noise, Role};
use crate::decision::{Decider, margin};
use crate::errors::{EncodeError, FollowError, InputError, InstructionError, RunError, StepError};
use crate::inputs::{self, Data};
use crate::normal::Normals;
use crate::policy::Policy;
use crate::run::{Counters, Draws, Rows, Run};
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
    /// The index in force; `None` for a policy that selects none.
    pub selected: Option<Selected>,
}

/// The index in force, such as that of a latent plan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Selected {
    /// Which one, below [`Policy::index_count`].
    pub index: u32,
    /// The largest score of the last selection minus the second largest; infinite with a single one.
    pub margin: f32,
    /// Whether this step selected it.
    pub fresh: bool,
}

/// Noise and the state of its generator.
#[derive(Debug, Clone)]
enum NoiseStream {
    Zero,
    Seeded { seed: u64, normals: Normals },
}

impl NoiseStream {
    fn new(noise: Noise) -> Self {
        match noise {
            Noise::Zero => Self::Zero,
            Noise::Seeded { seed } => Self::Seeded {
                seed,
                normals: Normals::new(seed),
            },
        }
    }
}

/// A policy at work in memory that the caller lent.
#[derive(Debug)]
pub struct Controller<'a, 'm> {
    policy: Policy<'a>,
    workspace: Workspace<'m>,
    decider: Decider,
    noise: NoiseStream,
    counters: Counters,
    /// Rows of KV caches that belong to the instruction.
    base: [u32; MAX_ROW_STATES],
    /// Whether an instruction is set, or the policy takes none.
    instructed: bool,
    /// Whether a step has been taken in this episode.
    stepped: bool,
    /// Whether the recorded episode was replayed without a difference.
    tested: bool,
}

impl<'a, 'm> Controller<'a, 'm> {
    /// A controller with the contract's decision rule and no instruction yet, on the widest instructions that this CPU offers.
    /// The workspace has to be one made for this policy: with that of another policy, calls fail with [`ExecError::Span`].
    pub fn new(policy: Policy<'a>, workspace: Workspace<'m>) -> Self {
        Self::with_isa(policy, workspace, Isa::detect())
    }

    /// A controller on chosen instructions; the results have the same bits on all of them. [`Isa::portable`] runs the same machine
    /// code on every CPU of a target.
    pub fn with_isa(policy: Policy<'a>, mut workspace: Workspace<'m>, isa: Isa) -> Self {
        workspace.isa = isa;
        Self {
            decider: Decider::new(policy.contract().decision()),
            noise: NoiseStream::new(policy.contract().noise()),
            counters: Counters::START,
            base: [0; MAX_ROW_STATES],
            instructed: policy.contract().instruction_channel().is_none(),
            stepped: false,
            tested: false,
            policy,
            workspace,
        }
    }

    /// The policy at work.
    pub fn policy(&self) -> &Policy<'a> {
        &self.policy
    }

    /// The instructions that it runs on.
    pub fn isa(&self) -> Isa {
        self.workspace.isa
    }

    /// Changes how an index is picked, from the next selection on. Sampling starts again from the seed.
    pub fn set_decision(&mut self, decision: Decision) {
        self.decider = Decider::new(decision);
    }

    /// How an index is picked.
    pub fn decision(&self) -> Decision {
        self.decider.rule()
    }

    /// Changes where noise comes from, from the next step on. The generator starts again from the seed.
    pub fn set_noise(&mut self, noise: Noise) {
        self.noise = NoiseStream::new(noise);
    }

    /// Where noise comes from.
    pub fn noise(&self) -> Noise {
        match self.noise {
            NoiseStream::Zero => Noise::Zero,
            NoiseStream::Seeded { seed, .. } => Noise::Seeded { seed },
        }
    }

    /// Whether [`self_test`](Self::self_test) has passed.
    pub fn is_tested(&self) -> bool {
        self.tested
    }

    pub(crate) fn set_tested(&mut self, tested: bool) {
        self.tested = tested;
    }

    /// Whether there is an instruction to follow, or the policy takes none.
    pub fn is_instructed(&self) -> bool {
        self.instructed
    }

    /// Follows an instruction from the next step on: a new episode, `t = 0`. Sampling and noise go on where they were.
    ///
    /// A refused instruction changes nothing. [`InstructionError::Run`], which a sound image never causes, leaves the
    /// controller without an instruction.
    pub fn set_instruction(&mut self, instruction: Instruction) -> Result<(), InstructionError> {
        let contract = self.policy.contract();
        let channel = contract
            .instruction_channel()
            .ok_or(InstructionError::NotTaken)?
            .id();
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
        if words.len().checked_rem(dim) != Some(0) {
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
        self.instructed = false;
        self.take_in(&[(channel, Data::F32(words))], count as u32)
            .map_err(InstructionError::Run)?;
        self.instructed = true;
        self.reset();
        Ok(())
    }

    /// Runs the calls of a new instruction; what they leave in KV caches and plain states is kept over resets.
    fn take_in(&mut self, given: &[(ChannelId, Data)], words: u32) -> Result<(), RunError> {
        if !self.workspace.fits(&self.policy) {
            return Err(RunError::Program(ExecError::Span));
        }
        self.workspace.now.plain.fill(0.0);
        self.workspace.next.plain.fill(0.0);
        let mut run = Run {
            tables: self.policy.tables(),
            memory: &mut self.workspace,
            action: self.policy.contract().action().id().0,
            given,
            noise: self
                .policy
                .contract()
                .noise_channel()
                .map(|channel| channel.id().0),
            draws: Draws::Zero,
            counters: Counters::START,
            words,
            given_index: None,
        };
        for call in run.tables.due(Event::Instruct, 0) {
            run.call(&call)?;
        }
        let counters = run.counters;
        for (base, rows) in self.base.iter_mut().zip(counters.rows) {
            *base = rows.len;
        }
        self.counters = counters;
        self.workspace.now.copy_from(&self.workspace.next);
        Ok(())
    }

    /// Brings code, weights and KV caches into the processor's caches, so that the next step, whichever kind it is, is as fast as
    /// the ones after it: for right before the first step, or after a pause. Costs two to three control steps and changes nothing.
    pub fn warm(&mut self) {
        if !self.workspace.fits(&self.policy) {
            return;
        }
        // With a full context there may be nothing to come, but code and weights are the same.
        let mut counters = self.begin().map_or(self.counters, |begun| begun.counters);
        let first = counters.timestep == 0;
        // A table by timestep has no row for what only comes later.
        counters.timestep = counters.timestep.max(1);
        let tables = *self.policy.tables();
        for call in tables.calls().filter(|call| call.event == Event::Step) {
            let only_first = call.when == records::When::First;
            let Some(entry) = tables.entry(call.entry as usize) else {
                continue;
            };
            let mut run = Run {
                tables: &tables,
                memory: &mut self.workspace,
                action: self.policy.contract().action().id().0,
                given: &[],
                noise: None,
                draws: Draws::Zero,
                counters,
                words: 0,
                given_index: None,
            };
            if only_first {
                run.counters.timestep = 0;
            }
            // A cache that the call clears has another half, which holds nothing that counts.
            let cleared = tables.clears(&call).iter();
            let cleared = cleared
                .map(|&state| run.clear(state))
                .all(|done| done.is_ok());
            // What is appended lies behind the rows that count, where the next step writes too; nothing else is stored. A program
            // that fails does so again in the step, which reports it.
            let room = entry.cache == records::NONE || has_room(&tables, &entry, &run.counters);
            if cleared && room && (first || !only_first) {
                let _ = run.entry(&entry, 0);
            }
        }
    }

    /// Starts a new episode with the same instruction: `t = 0`, what the instruction left stays. Sampling and noise go on where
    /// they were.
    pub fn reset(&mut self) {
        self.counters = self.cleared(self.counters);
        self.counters.selected = 0;
        self.counters.margin = 0.0;
        clear_plain(self.policy.tables(), self.workspace.now.plain);
        self.workspace.now.action.fill(0.0);
        self.stepped = false;
    }

    /// The counters at the beginning of an episode or a context.
    fn cleared(&self, counters: Counters) -> Counters {
        let mut cleared = counters;
        cleared.timestep = 0;
        for (i, (rows, &base)) in cleared.rows.iter_mut().zip(&self.base).enumerate() {
            let state = self.policy.tables().state(i);
            let Some(state) = state.filter(|state| state.scope == Scope::Episode) else {
                continue;
            };
            *rows = match state.kind {
                StateKind::Ring => rows.emptied(&state),
                // The instruction's rows lie in the first half; a cache that calls clear has none.
                _ => Rows {
                    len: base,
                    start: 0,
                },
            };
        }
        cleared
    }

    /// One control step of a policy with a single observation channel of floats: writes the action for an observation, both in
    /// the contract's units.
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

    /// One control step of any policy: writes the action for the values of all observation channels, in any order. Values for
    /// the noise channel, [`Policy::noise_len`] of them in the order in which they are used, take the place of the generator's.
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

    fn fits(&self, action: &[f32]) -> Result<(), StepError> {
        let (got, needed) = (action.len(), self.policy.contract().action_len());
        if got == needed {
            Ok(())
        } else {
            Err(StepError::ActionLength { got, needed })
        }
    }

    /// Tells the controller what was really executed since the last step, where that is not the action it returned; the next
    /// step sees it as the previous action, clipped to the contract's limits.
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
        let now = self.workspace.now.action.iter_mut();
        for ((to, &from), limits) in now.zip(action).zip(contract.action_limits()) {
            *to = limits.clamp(from);
        }
        Ok(())
    }

    /// The scores of the last selection, one per index; zeros before the first, empty for a policy that selects nothing.
    pub fn scores(&self) -> &[f32] {
        let Some(scores) = self.policy.sizes.scores else {
            return &[];
        };
        let start = scores.offset as usize;
        self.workspace
            .now
            .plain
            .get(start..start.saturating_add(scores.width as usize))
            .unwrap_or(&[])
    }

    /// The action of the last step, or what [`executed`](Self::executed) said.
    pub fn last_action(&self) -> &[f32] {
        self.workspace.now.action
    }

    /// The action for what is observed and an index that the caller chose, clipped to the contract's limits. Changes nothing in
    /// the episode under way, and needs no instruction.
    pub fn follow(
        &mut self,
        inputs: &[(ChannelId, Data)],
        index: u32,
        action: &mut [f32],
    ) -> Result<(), FollowError> {
        if !self.policy.follows() {
            return Err(FollowError::NotOffered);
        }
        let contract = self.policy.contract();
        let (got, needed) = (action.len(), contract.action_len());
        if got != needed {
            return Err(FollowError::ActionLength { got, needed });
        }
        let count = self.policy.index_count();
        if index >= count {
            return Err(FollowError::Index { got: index, count });
        }
        match *inputs {
            [(id, Data::F32(values))] if contract.only_observation() == Ok(id) => {
                contract.check_only(values)?;
            }
            _ => {
                inputs::check(contract, Role::Observation, inputs, 0)?;
            }
        }
        let mut counters = self.counters;
        counters.selected = index;
        self.aside(Event::Follow, inputs, counters)?;
        let limits = self.policy.contract().action_limits();
        let computed = self.workspace.next.action.iter();
        for ((to, &from), limits) in action.iter_mut().zip(computed).zip(limits) {
            *to = limits.clamp(from);
        }
        Ok(())
    }

    /// The index that a piece of a demonstration follows, from the values of all demonstration channels. Changes nothing in the
    /// episode under way.
    pub fn encode(&mut self, inputs: &[(ChannelId, Data)]) -> Result<u32, EncodeError> {
        if !self.policy.encodes() {
            return Err(EncodeError::NoEncoder);
        }
        inputs::check(self.policy.contract(), Role::Demonstration, inputs, 0)?;
        let selected = self.aside(Event::Encode, inputs, self.counters)?;
        Ok(selected.unwrap_or(0))
    }

    /// Runs the calls of an event that leaves the episode alone: the second bank holds nothing between two steps.
    fn aside(
        &mut self,
        event: Event,
        given: &[(ChannelId, Data)],
        counters: Counters,
    ) -> Result<Option<u32>, RunError> {
        if !self.workspace.fits(&self.policy) {
            return Err(RunError::Program(ExecError::Span));
        }
        let Workspace { now, next, .. } = &mut self.workspace;
        next.copy_from(now);
        let mut run = Run {
            tables: self.policy.tables(),
            memory: &mut self.workspace,
            action: self.policy.contract().action().id().0,
            given,
            noise: self
                .policy
                .contract()
                .noise_channel()
                .map(|channel| channel.id().0),
            draws: Draws::Zero,
            counters,
            words: 0,
            given_index: None,
        };
        for call in run.tables.due(event, 0) {
            run.call(&call)?;
        }
        Ok(run.given_index)
    }

    /// A controller as [`new`](Self::new) made it, but for the rules of decision and noise.
    pub(crate) fn renew(&mut self, rule: Decision, noise: Noise) {
        self.instructed = self.policy.contract().instruction_channel().is_none();
        self.base = [0; MAX_ROW_STATES];
        self.counters = Counters::START;
        self.reset();
        self.workspace.now.plain.fill(0.0);
        self.set_decision(rule);
        self.set_noise(noise);
    }

    /// A control step that leaves its action in the state. What is given was checked.
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
        let mut run = Run {
            tables: self.policy.tables(),
            memory: &mut self.workspace,
            action: self.policy.contract().action().id().0,
            given,
            noise: self
                .policy
                .contract()
                .noise_channel()
                .map(|channel| channel.id().0),
            draws,
            counters,
            words: 0,
            given_index: None,
        };
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
        let limits = self.policy.contract().action_limits();
        for (value, limits) in self.workspace.next.action.iter_mut().zip(limits) {
            *value = limits.clamp(*value);
        }

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

    /// The timestep after this one. In a context without end it goes back, before it would overflow, to one of the same phase.
    fn following(&self, timestep: u32) -> u32 {
        /// Some 24 days at a kilohertz.
        const FAR: u32 = 1 << 31;
        let next = timestep.saturating_add(1);
        let period = self.policy.sizes.period;
        let back = self.policy.contract().context_steps().is_none()
            && next >= FAR
            && next.is_multiple_of(period);
        if back { period } else { next }
    }

    /// Where the coming step starts: a full context restarts behind the instruction, or refuses.
    fn begin(&self) -> Result<Begun, StepError> {
        if !self.instructed {
            return Err(StepError::NoInstruction);
        }
        let contract = self.policy.contract();
        let full = contract
            .context_steps()
            .filter(|&steps| self.counters.timestep as usize >= steps);
        let Some(steps) = full else {
            return Ok(Begun {
                counters: self.counters,
                restarts: false,
            });
        };
        match contract.beyond() {
            Beyond::Restart => Ok(Begun {
                counters: self.cleared(self.counters),
                restarts: true,
            }),
            Beyond::Refuse => Err(StepError::ContextFull { steps }),
        }
    }
}

/// Where a step starts.
struct Begun {
    counters: Counters,
    /// Whether the context starts again.
    restarts: bool,
}

/// Whether a program can append to its KV cache behind the rows that count.
fn has_room(tables: &Tables, entry: &records::EntryRecord, counters: &Counters) -> bool {
    let rows = tables
        .state(entry.cache as usize)
        .map_or(0, |state| state.rows);
    counters.rows(entry.cache).len.saturating_add(entry.tokens) <= rows
}

/// Sets the plain states of an episode to zero.
fn clear_plain(tables: &Tables, plain: &mut [f32]) {
    for state in (0..tables.states_len()).filter_map(|i| tables.state(i)) {
        if state.kind == StateKind::Plain && state.scope == Scope::Episode {
            let start = state.offset as usize;
            let end = start.saturating_add(state.width as usize);
            if let Some(part) = plain.get_mut(start..end) {
                part.fill(0.0);
            }
        }
    }
}

impl Contract<'_> {
    /// The only observation channel, if it is one of floats.
    #[inline]
    fn only_observation(&self) -> Result<ChannelId, InputError> {
        let channel = self.observation();
        let id = channel.id();
        if channel.dtype() != DType::F32 {
            return Err(InputError::Type { channel: id.0 });
        }
        if self.observations_len() > 1 {
            let other = self
                .observations()
                .nth(1)
                .map_or(id, |channel| channel.id());
            return Err(InputError::Missing { channel: other.0 });
        }
        Ok(id)
    }

    /// Checks the values of the only observation channel.
    #[inline]
    fn check_only(&self, values: &[f32]) -> Result<(), InputError> {
        let channel = self.observation();
        let (got, needed) = (values.len(), channel.len());
        if got != needed {
            return Err(InputError::Length {
                channel: channel.id().0,
                got,
                needed,
            });
        }
        inputs::check_floats(channel.id(), values, channel.limits())
    }
}
