//! A small environment that needs no simulator, for the small bundle that the compiler's tests use.

use std::path::Path;
use std::sync::LazyLock;

use lads_compiler::Contract;
use lads_core::Policy;
use lads_host::Opened;
use lads_sim::environment::{
    ActionError, Completion, Description, Environment, EpisodeSeed, latch,
};
use lads_sim::random::Stream;

static TINY: LazyLock<Opened> = LazyLock::new(|| {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../runtime/compiler/tests/data/tiny.onnx");
    lads_host::open(&path).unwrap()
});

/// Compiles the small bundle.
pub fn tiny_policy() -> Policy<'static> {
    TINY.policy()
}

/// Returns the contract of the small bundle.
pub fn tiny_contract() -> &'static Contract {
    TINY.bundle().unwrap().contract()
}

/// Describes the environment; tests change one field at a time.
pub const DESCRIPTION: Description = Description {
    id: "tiny-bench",
    version: "1",
    control_period_s: 0.05,
    observation_names: &["joint1", "joint2", "drawer", "lamp", "lever"],
    action_names: &["joint1_velocity", "joint2_velocity", "gripper"],
    sub_tasks: &["drawer", "lamp", "lever"],
};

/// Five numbers that drift with the actions and with noise, inside the contract's limits; a sub-task is done once its number is high.
pub struct Bench {
    description: Description,
    stream: Stream,
    state: [f64; 5],
    observation: [f64; 5],
    steps: usize,
    completions: Vec<Completion>,
}

impl Bench {
    pub fn new(description: Description) -> Self {
        let (state, observation) = ([0.0; 5], [0.0; 5]);
        Self {
            description,
            stream: Stream::new(&[]),
            state,
            observation,
            steps: 0,
            completions: Vec::new(),
        }
    }

    fn observe(&mut self) {
        for (seen, truth) in self.observation.iter_mut().zip(self.state) {
            *seen = truth + self.stream.uniform(-0.05, 0.05);
        }
    }
}

impl Environment for Bench {
    fn description(&self) -> &Description {
        &self.description
    }
    fn max_steps(&self, _split: &str) -> usize {
        40
    }

    fn reset(&mut self, seed: EpisodeSeed, _commanded: &[usize]) -> &[f64] {
        self.stream = Stream::new(&seed.entropy());
        self.state = [0.0; 5];
        self.steps = 0;
        self.completions.clear();
        self.observe();
        &self.observation
    }

    fn step(&mut self, action: &[f64]) -> Result<&[f64], ActionError> {
        assert!(action.len() == 3 && action.iter().all(|x| x.is_finite()));
        self.steps += 1;
        for (index, value) in self.state.iter_mut().enumerate() {
            let drift = 0.02 * action[index % 3] + self.stream.uniform(0.0, 0.02);
            *value = (*value + drift).clamp(-0.05, 0.5);
        }
        for (sub_task, value) in self.state[2..].iter().enumerate() {
            if *value > 0.2 {
                latch(&mut self.completions, sub_task, self.steps);
            }
        }
        self.observe();
        Ok(&self.observation)
    }

    fn observation(&self) -> &[f64] {
        &self.observation
    }
    fn state(&self) -> &[f64] {
        &self.state
    }
    fn steps(&self) -> usize {
        self.steps
    }
    fn completions(&self) -> &[Completion] {
        &self.completions
    }
}
