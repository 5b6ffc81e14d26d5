//! Plans at the start of episodes, drawn anew: the policy sees what it saw in the first control step of recorded episodes, and its rule of
//! decision draws, whatever rule the episodes had.
//!
//! Only a policy that keeps its plan as a vector from one decision to the next has any: an entry of its codebook, or a draw from a normal
//! distribution. What can fail: what a replay of these steps can, see [`ReplayError`].

use std::collections::BTreeMap;

use lads_core::{Instruction, Noise};
use lads_host::Memory;

use crate::environment::EpisodeSeed;
use crate::evaluate::{Evaluation, stream_seed};
use crate::plans;
use crate::replay::{self, ReplayError};
use crate::trace::Trace;

/// Fourth number of the entropy of the stream that seeds a draw.
const START_STREAM: u64 = 6;

/// Number of plans that are drawn of each instruction, as in the paper (appendix E.4).
pub const DRAWS: u32 = 50;

/// A plan that was drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct Draw {
    /// Index of the plan; `None` of a policy whose plans are vectors alone.
    pub plan: Option<u32>,
    /// Vector of the plan, as the low level gets it.
    pub vector: Vec<f32>,
}

/// Plans drawn at the start of episodes, by instruction.
pub type Drawn = BTreeMap<u32, Vec<Draw>>;

/// Draws [`DRAWS`] plans of each of the `instructions`, in the first control steps of their traced episodes in turn; empty for a policy that
/// keeps no plan.
pub fn draw(
    evaluation: &Evaluation<'_>,
    traces: &[Trace],
    instructions: &[u32],
) -> Result<Drawn, ReplayError> {
    let (policy, contract) = (&evaluation.policy, evaluation.policy.contract());
    let mut memory = Memory::of(policy).map_err(ReplayError::Memory)?;
    let mut controller = memory
        .controller_with(policy, evaluation.isa)
        .map_err(ReplayError::Memory)?;
    let mut drawn = Drawn::new();
    if controller.state(plans::VECTOR).is_none() {
        return Ok(drawn);
    }
    let mut action = vec![0.0; contract.action_len()];
    for &instruction in instructions {
        let own = traces.iter().filter(|it| it.instruction == instruction);
        let starts: Vec<_> = own
            .filter_map(|trace| Some((trace.episode, trace.steps.first()?)))
            .collect();
        let of_instruction = drawn.entry(instruction).or_default();
        for (number, &(episode, step)) in (0..DRAWS).zip(starts.iter().cycle()) {
            let seed = EpisodeSeed {
                seed: evaluation.seed,
                instruction: u64::from(instruction),
                episode: u64::from(number),
            };
            let seed = stream_seed(seed, START_STREAM);
            controller.set_decision(contract.sampling(seed));
            controller.set_noise(Noise::Seeded { seed });
            let words = evaluation.setup.words.and_then(|it| it.of(instruction));
            controller
                .set_instruction(words.map_or(Instruction::Id(instruction), Instruction::Words))
                .map_err(ReplayError::Instruct)?;
            let named = || format!("instruction {instruction} episode {episode}");
            let given = replay::Given::at(contract, step).map_err(|bad| bad.at(named(), 0))?;
            let seen = given.data();
            let report = controller.step_with(&seen, &mut action);
            let report = report.map_err(|error| ReplayError::Step {
                episode: named(),
                step: 0,
                error,
            })?;
            of_instruction.push(Draw {
                plan: report.selected.map(|selected| selected.index),
                vector: controller.state(plans::VECTOR).unwrap_or_default().to_vec(),
            });
        }
    }
    Ok(drawn)
}
