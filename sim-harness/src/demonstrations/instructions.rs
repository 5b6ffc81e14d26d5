//! Instructions of an environment: texts, their sub-tasks in order, and the split into seen and unseen.

use serde::{Deserialize, Serialize};

const KITCHEN: &str = include_str!("../../../models/kitchen.instructions.json");

/// An instruction of an environment.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Instruction {
    /// Short name, the sub-tasks' initials.
    pub id: String,
    /// Names of the commanded sub-tasks, in the order of execution.
    pub sub_tasks: Vec<String>,
    /// The sentence that the policy is given.
    pub text: String,
}

/// Instructions in two splits, seen and unseen.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct Instructions {
    /// Instructions with demonstrations.
    pub seen: Vec<Instruction>,
    /// Instructions that no policy may be trained on.
    pub unseen: Vec<Instruction>,
}

impl Instructions {
    /// Loads Franka Kitchen's 22 seen and 3 unseen instructions from models/kitchen.instructions.json.
    ///
    /// # Panics
    /// If that file, which is compiled in, is malformed: a test reads it.
    pub fn kitchen() -> Self {
        serde_json::from_str(KITCHEN)
            .unwrap_or_else(|error| panic!("models/kitchen.instructions.json: {error}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kitchen::spec::SUB_TASK_NAMES;

    #[test]
    fn every_instruction_names_four_different_sub_tasks() {
        let instructions = Instructions::kitchen();
        assert_eq!(
            (instructions.seen.len(), instructions.unseen.len()),
            (22, 3)
        );
        for instruction in instructions.seen.iter().chain(&instructions.unseen) {
            let mut names = instruction.sub_tasks.clone();
            assert!(
                names
                    .iter()
                    .all(|name| SUB_TASK_NAMES.contains(&name.as_str())),
                "{names:?}"
            );
            names.sort();
            names.dedup();
            assert_eq!(names.len(), 4, "{}", instruction.id);
        }
    }
}
