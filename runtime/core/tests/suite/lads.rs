//! Compares the controller with the naive model, which computes everything anew in 64 bits.

use crate::support::assemble::parts;
use crate::support::{Memory, Model, Random, Spec};
use lads_core::{Controller, Instruction};

fn tiny() -> Model {
    Model::random(Spec::TINY, 11)
}

/// Runs an episode beside the naive model and returns the largest difference of an action.
fn compare(model: &Model, words: &[f32], steps: usize, controller: &mut Controller) -> f64 {
    let spec = model.spec;
    let mut random = Random(99);
    let (mut observations, mut actions) = (Vec::new(), Vec::new());
    let mut plan = 0;
    let mut largest = 0.0_f64;
    for step in 0..steps {
        let t = step % spec.steps;
        if t == 0 {
            observations.clear();
            actions.clear();
        }
        observations.push(random.vec(spec.observation_len, 1.0));
        let mut action = vec![0.0; spec.action_len];
        let report = controller
            .step(&observations[t], &mut action)
            .expect("the step is sound");
        assert_eq!(report.timestep as usize, t);
        let selected = report.selected.expect("it selects");
        assert_eq!(selected.fresh, t.is_multiple_of(spec.horizon));
        if selected.fresh {
            let logits = model.logits(words, &observations, &actions);
            for (&logit, expected) in controller.scores().iter().zip(&logits) {
                assert!(
                    (f64::from(logit) - expected).abs() < 1e-4,
                    "step {step}: {logit} against {expected}"
                );
            }
            let mut sorted = logits.clone();
            sorted.sort_by(|a, b| b.total_cmp(a));
            assert!((f64::from(selected.margin) - (sorted[0] - sorted[1])).abs() < 2e-4);
            plan = logits
                .iter()
                .position(|&logit| logit == sorted[0])
                .expect("one is the largest");
        }
        assert_eq!(selected.index, plan as u32, "step {step}");
        for (&got, expected) in action.iter().zip(model.act(&observations[t], plan)) {
            largest = largest.max((f64::from(got) - expected).abs());
        }
        actions.push(action);
    }
    largest
}

#[test]
fn an_episode_equals_the_naive_model() {
    let model = tiny();
    let image = parts(&model).image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    for (id, words) in model.instructions.iter().enumerate() {
        controller
            .set_instruction(Instruction::Id(id as u32))
            .expect("the instruction is known");
        let largest = compare(&model, words, model.spec.steps, &mut controller);
        assert!(largest < 1e-5, "actions differ by {largest}");
    }
    // Words of our own, fewer than the longest instruction; the second episode starts from a reset.
    let words = Random(4).vec(model.spec.word_dim, 1.0);
    controller
        .set_instruction(Instruction::Words(&words))
        .expect("one word is enough");
    compare(&model, &words, 5, &mut controller);
    controller.reset();
    compare(&model, &words, 5, &mut controller);
}

#[test]
fn a_full_context_restarts_behind_the_words() {
    let model = tiny();
    let image = parts(&model).image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    controller
        .set_instruction(Instruction::Id(1))
        .expect("the instruction is known");
    let largest = compare(
        &model,
        &model.instructions[1],
        3 * model.spec.steps + 2,
        &mut controller,
    );
    assert!(largest < 1e-5, "actions differ by {largest}");
}

#[test]
fn the_sizes_of_kitchen_equal_the_naive_model() {
    let spec = Spec {
        steps: 12,
        horizon: 5,
        ..Spec::KITCHEN
    };
    let model = Model::random(spec, 3);
    let image = parts(&model).image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    controller
        .set_instruction(Instruction::Id(0))
        .expect("the instruction is known");
    let largest = compare(&model, &model.instructions[0], 12, &mut controller);
    assert!(largest < 2e-5, "actions differ by {largest}");
}

#[test]
fn the_executed_action_reaches_the_naive_model_too() {
    let model = tiny();
    let image = parts(&model).image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    controller
        .set_instruction(Instruction::Id(0))
        .expect("the instruction is known");
    let mut random = Random(8);
    let observations: Vec<_> = (0..4).map(|_| random.vec(3, 1.0)).collect();
    let executed: Vec<_> = (0..3).map(|_| random.vec(2, 1.0)).collect();
    for (t, observation) in observations.iter().enumerate() {
        controller
            .step(observation, &mut [0.0; 2])
            .expect("the step is sound");
        if let Some(action) = executed.get(t) {
            controller.executed(action).expect("the action is sound");
        }
    }
    let expected = model.logits(&model.instructions[0], &observations, &executed);
    for (&got, expected) in controller.scores().iter().zip(expected) {
        assert!((f64::from(got) - expected).abs() < 1e-4);
    }
}

#[test]
fn the_plan_in_force_is_read_by_its_name() {
    let model = tiny();
    let image = parts(&model).image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    let zeros = vec![0.0; model.spec.plan_len];
    assert_eq!(controller.state("plan"), Some(zeros.as_slice()));
    controller
        .set_instruction(Instruction::Id(0))
        .expect("the instruction is known");
    let mut random = Random(5);
    let mut action = vec![0.0; model.spec.action_len];
    for _ in 0..=model.spec.horizon {
        let observation = random.vec(model.spec.observation_len, 1.0);
        let report = controller.step(&observation, &mut action);
        let report = report.expect("the step is sound");
        let index = report.selected.expect("it selects").index as usize;
        assert_eq!(controller.state("plan"), Some(model.plan(index)));
        assert_eq!(controller.state("logits"), Some(controller.scores()));
    }
    for name in ["context", "", "plans"] {
        assert_eq!(controller.state(name), None, "{name}");
    }
}
