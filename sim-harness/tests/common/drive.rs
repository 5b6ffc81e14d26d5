//! A few episodes of a changed policy in closed loop: does what the change moves reach the success?

use std::sync::atomic::AtomicBool;

use lads_core::Isa;
use lads_host::Opened;
use lads_proof::reference::Reference;
use lads_sim::evaluate::{Assignment, Evaluation, Setup};
use lads_sim::registry::{self, Opener};
use lads_sim::rollout::Actor;
use lads_sim::{assets, fit};

/// Outcome of one episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outcome {
    /// Whether the instruction was carried out.
    pub success: bool,
    /// Commanded sub-tasks that were completed, in the environment's order.
    pub sub_tasks: Vec<usize>,
}

/// The first episode of some instructions, seeded as the reference's is.
pub struct Rollouts {
    open: Opener,
    assignments: Vec<Assignment>,
    seed: u64,
    threads: usize,
}

impl Rollouts {
    /// Takes the instructions whose index is a multiple of `every`; `opened` is the bundle without a change.
    pub fn new(opened: &Opened, reference: &Reference, every: usize, threads: usize) -> Self {
        let contract = opened.bundle().unwrap().contract();
        let id = &contract.environment.id;
        let open = registry::load(id, &reference.noise, &assets::vendor_dir());
        let open = open.unwrap_or_else(|error| panic!("{error}"));
        let environment = open();
        let commanded = fit::check(contract, environment.as_ref()).unwrap();
        let assignments = (0..).zip(commanded).step_by(every);
        let assignments = assignments.map(|(instruction, commanded)| Assignment {
            instruction,
            commanded,
            max_steps: environment.max_steps(contract.evaluated(instruction as usize).1),
        });
        Self {
            assignments: assignments.collect(),
            open,
            seed: reference.seed,
            threads,
        }
    }

    /// Number of sub-tasks that the episodes command.
    pub fn commanded(&self) -> usize {
        self.assignments.iter().map(|it| it.commanded.len()).sum()
    }

    /// Indices of the instructions.
    #[cfg(test)]
    pub fn instructions(&self) -> impl Iterator<Item = usize> {
        self.assignments.iter().map(|it| it.instruction as usize)
    }

    /// Runs the episodes. An observation that is refused ends its episode, as it would stop a machine; any other refusal is the error.
    pub fn run(&self, opened: &Opened) -> Result<Vec<Outcome>, String> {
        let (policy, contract) = (opened.policy(), opened.bundle().unwrap().contract());
        let environment = (self.open)();
        fit::check(contract, environment.as_ref()).map_err(|misfit| misfit.to_string())?;
        let evaluation = Evaluation {
            policy,
            contract,
            assignments: &self.assignments,
            episodes: 1,
            seed: self.seed,
            decision: policy.contract().decision(),
            actor: Actor::Policy,
            isa: Isa::detect(),
            threads: self.threads,
            setup: Setup {
                stop_where_refused: true,
                ..Setup::default()
            },
        };
        let evaluated = evaluation.run(&*self.open, &AtomicBool::new(false), &|| {});
        let evaluated = evaluated.map_err(|error| error.to_string())?;
        let episodes = self.assignments.iter().zip(&evaluated.episodes);
        let outcomes = episodes.map(|(assignment, episodes)| {
            let episode = &episodes[0];
            let done = |sub_task: &usize| {
                episode
                    .completions
                    .iter()
                    .any(|it| it.sub_task == *sub_task)
            };
            let mut sub_tasks: Vec<_> = assignment.commanded.iter().copied().filter(done).collect();
            sub_tasks.sort_unstable();
            Outcome {
                success: episode.success,
                sub_tasks,
            }
        });
        Ok(outcomes.collect())
    }
}
