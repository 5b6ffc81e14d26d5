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
//! - A call that returns an error leaves the controller unchanged: a step writes its results to a
//!   second bank and to rows that are not yet valid, and commits them at the end. (One exception:
//!   see [`Controller::set_instruction`].)
//! - An action that leaves the controller is finite and inside the contract's limits.
//! - Nothing is allocated, no call blocks, and the work of a step is bounded by what the image states.

mod aside;
mod instruct;
mod step;

use lads_image::Tables;
use lads_image::records::{MAX_ROW_STATES, Scope, StateKind};
use lads_kernels::Isa;

use crate::contract::{Beyond, Decision, Noise, same_text};
use crate::decision::Decider;
use crate::errors::StepError;
use crate::normal::Normals;
use crate::policy::Policy;
use crate::run::{Counters, Rows};
use crate::workspace::Workspace;

/// Instruction that a policy is to follow.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Instruction<'w> {
    /// Number of an instruction in the contract.
    Id(u32),
    /// Word embeddings, `[n, word_dim]` with `n` from 1 to the contract's `words_len`.
    ///
    /// Any embeddings are followed, even of nonsense: compare them with the known instructions
    /// first, by [`similarity::nearest`](crate::similarity::nearest).
    Words(&'w [f32]),
}

/// Result of a control step, besides the action.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// Control steps since the context began: 0 in the first step after an instruction, a reset or a restart of the context.
    pub timestep: u32,
    /// The index in force; `None` for a policy that selects none.
    pub selected: Option<Selected>,
}

/// The index in force, such as that of a latent plan, and how it was selected.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Selected {
    /// Index selected, below [`Policy::index_count`].
    pub index: u32,
    /// The largest score of the last selection minus the second largest; infinite with a single one.
    pub margin: f32,
    /// True if this step selected the index.
    pub fresh: bool,
}

/// Source of noise, with the state of its generator.
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

/// A running policy in memory that the caller lends.
#[derive(Debug)]
pub struct Controller<'a, 'm> {
    policy: Policy<'a>,
    workspace: Workspace<'m>,
    decider: Decider,
    noise: NoiseStream,
    counters: Counters,
    /// Valid rows of each KV cache that belong to the instruction.
    base: [u32; MAX_ROW_STATES],
    /// True if an instruction is set, or the policy takes none.
    instructed: bool,
    /// True if a step has been taken in this episode.
    stepped: bool,
    /// True if the recorded episode was replayed without a difference.
    tested: bool,
}

impl<'a, 'm> Controller<'a, 'm> {
    /// Makes a controller with the contract's decision rule and no instruction yet, on the widest
    /// instruction set that this CPU offers. The workspace has to be made for this policy; with
    /// that of another policy, calls fail with [`ExecError::Span`](crate::ExecError::Span).
    pub fn new(policy: Policy<'a>, workspace: Workspace<'m>) -> Self {
        Self::with_isa(policy, workspace, Isa::detect())
    }

    /// Makes a controller that runs on a chosen instruction set; the results have the same bits on
    /// all of them. [`Isa::portable`] runs the same machine code on every CPU of a target.
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

    /// Returns the policy that this controller runs.
    pub fn policy(&self) -> &Policy<'a> {
        &self.policy
    }

    /// Returns the instruction set that the controller runs on.
    pub fn isa(&self) -> Isa {
        self.workspace.isa
    }

    /// Changes the rule that picks an index, from the next selection on. Sampling starts again from
    /// the seed.
    pub fn set_decision(&mut self, decision: Decision) {
        self.decider = Decider::new(decision);
    }

    /// Returns the rule that picks an index.
    pub fn decision(&self) -> Decision {
        self.decider.rule()
    }

    /// Changes the source of noise, from the next step on. The generator starts again from the
    /// seed.
    pub fn set_noise(&mut self, noise: Noise) {
        self.noise = NoiseStream::new(noise);
    }

    /// Returns the source of noise.
    pub fn noise(&self) -> Noise {
        match self.noise {
            NoiseStream::Zero => Noise::Zero,
            NoiseStream::Seeded { seed, .. } => Noise::Seeded { seed },
        }
    }

    /// Returns whether [`self_test`](Self::self_test) has passed.
    pub fn is_tested(&self) -> bool {
        self.tested
    }

    pub(crate) fn set_tested(&mut self, tested: bool) {
        self.tested = tested;
    }

    /// Returns whether an instruction is set, or the policy takes none.
    pub fn is_instructed(&self) -> bool {
        self.instructed
    }

    /// Starts a new episode with the same instruction at `t = 0`; the state that the instruction
    /// left is kept. Sampling and noise continue where they were.
    pub fn reset(&mut self) {
        self.counters = self.cleared(self.counters);
        self.counters.selected = 0;
        self.counters.margin = 0.0;
        clear_plain(self.policy.tables(), self.workspace.now.plain);
        self.workspace.now.action.fill(0.0);
        self.stepped = false;
    }

    /// Returns the counters at the beginning of an episode or a context.
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

    fn fits(&self, action: &[f32]) -> Result<(), StepError> {
        let (got, needed) = (action.len(), self.policy.contract().action_len());
        if got == needed {
            Ok(())
        } else {
            Err(StepError::ActionLength { got, needed })
        }
    }

    /// Returns the scores of the last selection, one per index; zeros before the first, empty for a
    /// policy that selects nothing.
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

    /// Returns the values of a plain state after the last step, by the state's name, such as those of the plan that
    /// a low level is given; zeros before the first step, `None` for states of rows and for those that end with
    /// their step.
    pub fn state(&self, name: &str) -> Option<&[f32]> {
        let tables = self.policy.tables();
        let state = (0..tables.states_len())
            .filter_map(|i| tables.state(i))
            .filter(|state| state.kind == StateKind::Plain && state.scope != Scope::Step)
            .find(|state| same_text(tables.text(state.name), name))?;
        let start = state.offset as usize;
        let end = start.saturating_add(state.width as usize);
        self.workspace.now.plain.get(start..end)
    }

    /// Returns the action of the last step, or the one passed to [`executed`](Self::executed)
    /// since.
    pub fn last_action(&self) -> &[f32] {
        self.workspace.now.action
    }

    /// Resets the controller to the state after [`new`](Self::new), with the given rules of
    /// decision and noise.
    pub(crate) fn renew(&mut self, rule: Decision, noise: Noise) {
        self.instructed = self.policy.contract().instruction_channel().is_none();
        self.base = [0; MAX_ROW_STATES];
        self.counters = Counters::START;
        self.reset();
        self.workspace.now.plain.fill(0.0);
        self.set_decision(rule);
        self.set_noise(noise);
    }

    /// Computes the start of the coming step: a full context restarts after the instruction, or
    /// refuses.
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

/// Start of a step.
struct Begun {
    counters: Counters,
    /// True if the context restarts.
    restarts: bool,
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
