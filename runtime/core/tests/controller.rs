//! The rules of the calls of a controller.

mod support;

use lads_core::image::{Beyond, DecisionRule, ProgramKind};
use lads_core::{
    ActError, Controller, Decision, Element, EncodeError, Instruction, InstructionError, Interval,
    PlanIndex, Policy, StepError,
};
use support::assemble::{parts, with_golden};
use support::{Image, Memory, Model, Random, Spec};

fn tiny() -> Model {
    Model::random(Spec::TINY, 11)
}

#[test]
fn the_low_level_alone_repeats_the_step_and_disturbs_nothing() {
    let model = tiny();
    let image = parts(&model).image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut undisturbed = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    let mut reference = undisturbed.controller(&policy);
    let mut random = Random(9);
    let mut action = vec![0.0; model.spec.action_len];
    let mut alone = action.clone();
    let other = PlanIndex(model.spec.codebook_len as u32 - 1);
    for controller in [&mut controller, &mut reference] {
        controller
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
    }
    for _ in 0..model.spec.steps {
        let observation = random.vec(model.spec.observation_len, 1.0);
        controller
            .act(&observation, other, &mut alone)
            .expect("the plan is in the codebook");
        let report = controller.step(&observation, &mut action);
        let mut wanted = action.clone();
        assert_eq!(report, reference.step(&observation, &mut wanted));
        assert_eq!(action, wanted);
        let plan = report.expect("the observation is accepted").plan;
        controller
            .act(&observation, plan, &mut alone)
            .expect("the plan is in the codebook");
        assert_eq!(alone, action);
    }
    let observation = random.vec(model.spec.observation_len, 1.0);
    let size = model.spec.codebook_len as u32;
    assert_eq!(
        controller.act(&observation, PlanIndex(size), &mut alone),
        Err(ActError::Plan { got: size, size })
    );
    assert_eq!(
        controller.act(&observation, PlanIndex(0), &mut []),
        Err(ActError::Length {
            got: 0,
            needed: model.spec.action_len
        })
    );
    let broken = vec![f32::NAN; model.spec.observation_len];
    assert_eq!(
        controller.act(&broken, PlanIndex(0), &mut alone),
        Err(ActError::NotFinite { index: 0 })
    );
}

#[test]
fn a_full_context_can_refuse() {
    let mut parts = parts(&tiny());
    parts.contract.beyond = Beyond::Refuse;
    let image = parts.image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    controller
        .set_instruction(Instruction::Id(0))
        .expect("the instruction is known");
    let mut action = [0.0; 2];
    for _ in 0..8 {
        controller
            .step(&[0.1; 3], &mut action)
            .expect("the context has room");
    }
    let before = action;
    assert_eq!(
        controller.step(&[0.1; 3], &mut action),
        Err(StepError::ContextFull { steps: 8 })
    );
    assert_eq!(action, before);
    controller.reset();
    assert_eq!(
        controller
            .step(&[0.1; 3], &mut action)
            .map(|report| report.timestep),
        Ok(0)
    );
}

/// The actions of an episode in which `between` is called before every step.
fn episode(
    image: &Image,
    decision: Decision,
    mut between: impl FnMut(&mut Controller, usize),
) -> (Vec<u32>, Vec<f32>) {
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    controller.set_decision(decision);
    controller
        .set_instruction(Instruction::Id(0))
        .expect("the instruction is known");
    let mut random = Random(1);
    let (mut plans, mut actions) = (Vec::new(), Vec::new());
    for step in 0..20 {
        between(&mut controller, step);
        let mut action = [0.0; 2];
        let report = controller
            .step(&random.vec(3, 1.0), &mut action)
            .expect("the step is sound");
        plans.push(report.plan.0);
        actions.extend(action);
    }
    (plans, actions)
}

#[test]
fn refused_input_leaves_the_controller_as_it_was() {
    let image = parts(&tiny()).image();
    for decision in [
        Decision::Argmax,
        Decision::Sample {
            temperature: 2.0,
            seed: 5,
        },
    ] {
        let undisturbed = episode(&image, decision, |_, _| {});
        let disturbed = episode(&image, decision, |controller, step| {
            let mut action = [7.0; 2];
            let mut refused =
                |observation: &[f32]| controller.step(observation, &mut action).unwrap_err();
            assert_eq!(
                refused(&[0.0; 2]),
                StepError::ObservationLength { got: 2, needed: 3 }
            );
            assert_eq!(
                refused(&[0.0, f32::NAN, 9.0]),
                StepError::NotFinite { index: 1 }
            );
            assert_eq!(
                refused(&[0.0, 0.0, f32::INFINITY]),
                StepError::NotFinite { index: 2 }
            );
            let outside = StepError::OutOfLimits {
                index: 2,
                value: -3.5,
                min: -3.0,
                max: 3.0,
            };
            assert_eq!(refused(&[0.0, 0.0, -3.5]), outside);
            assert_eq!(action, [7.0; 2]);
            let short = StepError::ActionLength { got: 1, needed: 2 };
            assert_eq!(controller.step(&[0.0; 3], &mut action[..1]), Err(short));
            assert_eq!(controller.executed(&[0.0]), Err(short));
            assert_eq!(
                controller.executed(&[f32::NAN, 0.0]),
                Err(StepError::NotFinite { index: 0 })
            );
            if step == 0 {
                assert_eq!(
                    controller.executed(&[0.0; 2]),
                    Err(StepError::NothingExecuted)
                );
            }
            let refused = controller.set_instruction(Instruction::Id(2));
            assert_eq!(refused, Err(InstructionError::Unknown { id: 2, count: 2 }));
            let refused = controller.set_instruction(Instruction::Words(&[0.0; 6]));
            assert_eq!(
                refused,
                Err(InstructionError::Length {
                    got: 6,
                    word_dim: 4
                })
            );
            let refused = controller.set_instruction(Instruction::Words(&[]));
            assert_eq!(refused, Err(InstructionError::Words { got: 0, most: 4 }));
            let refused = controller.set_instruction(Instruction::Words(&[0.0; 20]));
            assert_eq!(refused, Err(InstructionError::Words { got: 5, most: 4 }));
            let refused =
                controller.set_instruction(Instruction::Words(&[0.0, 0.0, f32::NAN, 0.0]));
            assert_eq!(refused, Err(InstructionError::NotFinite { index: 2 }));
            // Encoding a demonstration does not disturb the episode either.
            assert!(controller.encode(&[0.1; 9], &[0.2; 6]).is_ok());
        });
        assert_eq!(undisturbed, disturbed);
    }
}

#[test]
fn a_result_that_is_not_finite_is_refused_and_undone() {
    // Weights that overflow for a large second observation element and are harmless for a small one.
    let mut model = tiny();
    let d = model.spec.width();
    model.low[0].w[d..2 * d].fill(3e38);
    let image = parts(&model).image();
    let calm = |step: usize| [0.1, 0.0, 0.02 * step as f32];
    let run = |disturb: bool| {
        let policy = image.policy();
        let mut memory = Memory::for_policy(&policy);
        let mut controller = memory.controller(&policy);
        controller.set_decision(Decision::Sample {
            temperature: 5.0,
            seed: 2,
        });
        controller
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
        let mut seen = Vec::new();
        // 20 steps: decisions, ordinary steps and restarts of the context.
        for step in 0..20 {
            let mut action = [9.0; 2];
            if disturb {
                let refused = controller.step(&[0.1, 2.9, 0.0], &mut action);
                assert_eq!(refused, Err(StepError::NotFiniteResult));
                assert_eq!(action, [9.0; 2]);
            }
            let report = controller
                .step(&calm(step), &mut action)
                .expect("the step is sound");
            seen.push((report, action, controller.logits().to_vec()));
        }
        seen
    };
    assert_eq!(run(false), run(true));
}

#[test]
fn what_was_executed_goes_into_the_context() {
    let image = parts(&tiny()).image();
    let logits = |executed: Option<[f32; 2]>| {
        let policy = image.policy();
        let mut memory = Memory::for_policy(&policy);
        let mut controller = memory.controller(&policy);
        controller
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
        let mut returned = Vec::new();
        for _ in 0..4 {
            let mut action = [0.0; 2];
            controller
                .step(&[0.3; 3], &mut action)
                .expect("the step is sound");
            if let Some(executed) = executed {
                controller.executed(&executed).expect("the action is sound");
            }
            returned.push(action);
        }
        (controller.logits().to_vec(), returned)
    };
    let (plain, actions) = logits(None);
    assert_ne!(plain, logits(Some([0.9, -0.9])).0);
    // Beyond the limits is at the limits.
    assert_eq!(logits(Some([1.0, -1.0])).0, logits(Some([5.0, -7.0])).0);
    // Saying what was returned changes nothing.
    assert_eq!(actions[0], actions[1]);
    assert_eq!(plain, logits(Some(actions[0])).0);
}

#[test]
fn sampling_is_a_function_of_the_seed() {
    let image = parts(&tiny()).image();
    let sample = |seed| {
        episode(
            &image,
            Decision::Sample {
                temperature: 3.0,
                seed,
            },
            |_, _| {},
        )
    };
    assert_eq!(sample(1), sample(1));
    assert!((2..6).any(|seed| sample(seed).0 != sample(1).0));
    // Random numbers are used up: the first decision of each episode is another draw.
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    controller.set_decision(Decision::Sample {
        temperature: 10.0,
        seed: 1,
    });
    controller
        .set_instruction(Instruction::Id(0))
        .expect("the instruction is known");
    let mut draw = || {
        controller.reset();
        controller
            .step(&[0.1; 3], &mut [0.0; 2])
            .map(|report| report.plan.0)
    };
    let draws: Vec<_> = (0..30)
        .map(|_| draw().expect("the step is sound"))
        .collect();
    assert!((0..5).all(|plan| draws.contains(&plan)), "{draws:?}");
    // The contract's own rule is what a new controller starts with.
    let mut parts = parts(&tiny());
    (
        parts.contract.rule,
        parts.contract.temperature,
        parts.contract.seed,
    ) = (DecisionRule::Sample, 3.0, 1);
    let image = parts.image();
    let policy = image.policy();
    assert_eq!(
        memory_decision(&policy),
        Decision::Sample {
            temperature: 3.0,
            seed: 1
        }
    );
}

fn memory_decision(policy: &Policy) -> Decision {
    let mut memory = Memory::for_policy(policy);
    memory.controller(policy).decision()
}

#[test]
fn without_an_instruction_there_is_no_step() {
    let image = parts(&tiny()).image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    let mut action = [0.5; 2];
    assert_eq!(controller.logits(), [0.0; 5]);
    assert_eq!(
        controller.step(&[0.0; 3], &mut action),
        Err(StepError::NoInstruction)
    );
    controller.reset();
    assert_eq!(
        controller.step(&[0.0; 3], &mut action),
        Err(StepError::NoInstruction)
    );
    assert_eq!(action, [0.5; 2]);
}

#[test]
fn demonstrations_are_encoded_to_the_nearest_plan() {
    let model = tiny();
    let image = parts(&model).image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    let mut random = Random(21);
    let mut seen = std::collections::BTreeSet::new();
    for _ in 0..50 {
        let (observations, actions) = (random.vec(9, 1.0), random.vec(6, 1.0));
        let expected = model.encode(&observations, &actions) as u32;
        assert_eq!(
            controller.encode(&observations, &actions),
            Ok(PlanIndex(expected))
        );
        seen.insert(expected);
    }
    assert!(seen.len() > 1, "one plan for everything proves nothing");
    assert_eq!(
        controller.encode(&[0.0; 8], &[0.0; 6]),
        Err(EncodeError::Length { got: 8, needed: 9 })
    );
    assert_eq!(
        controller.encode(&[0.0; 9], &[0.0; 7]),
        Err(EncodeError::Length { got: 7, needed: 6 })
    );
    assert_eq!(
        controller.encode(&[0.0; 9], &[f32::NAN; 6]),
        Err(EncodeError::NotFinite)
    );

    let mut parts = parts(&model);
    parts.programs[ProgramKind::Encode as usize] = support::writer::empty_program();
    let image = parts.image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let refused = memory.controller(&policy).encode(&[0.0; 9], &[0.0; 6]);
    assert_eq!(refused, Err(EncodeError::NoEncoder));
}

#[test]
fn the_contract_says_what_was_written() {
    let model = tiny();
    let image = with_golden(parts(&model), 10).image();
    let policy = image.policy();
    assert!(policy.checksum_matches());
    let contract = policy.contract();
    assert_eq!(contract.environment_id(), "test");
    assert_eq!(
        (
            contract.observation_len(),
            contract.action_len(),
            contract.horizon()
        ),
        (3, 2, 3)
    );
    assert_eq!(contract.control_period_s(), 0.08);
    let element = contract.observation(2).expect("there are three");
    assert_eq!((element.name, element.unit), ("observation2", "rad"));
    assert_eq!(contract.observation(3), None);
    let element = contract.action(1).expect("there are two");
    assert_eq!((element.name, element.unit), ("action1", "rad"));
    assert_eq!(contract.action(2), None);
    // The two ways to the limits agree.
    let limits = |elements: &mut dyn Iterator<Item = Element<'_>>| -> Vec<Interval> {
        elements.map(|element| element.limits).collect()
    };
    let symmetric = |limit: f32| Interval {
        min: -limit,
        max: limit,
    };
    assert_eq!(limits(&mut contract.observations()), [symmetric(3.0); 3]);
    assert_eq!(
        contract.observation_limits().collect::<Vec<_>>(),
        [symmetric(3.0); 3]
    );
    assert_eq!(limits(&mut contract.actions()), [symmetric(1.0); 2]);
    assert_eq!(
        contract.action_limits().collect::<Vec<_>>(),
        [symmetric(1.0); 2]
    );
    assert_eq!(
        (contract.instruction_count(), contract.instruction_id(1)),
        (2, Some("id1"))
    );
    assert_eq!(contract.instruction_text(0), Some("instruction 0"));
    assert_eq!(
        contract.instruction(1).map(|known| known.words),
        Some(&model.instructions[1][..])
    );
    assert_eq!(contract.instruction(2), None);
    let golden = policy.golden().expect("there is one");
    assert_eq!(
        (golden.len(), golden.instruction(), golden.steps().count()),
        (10, 1, 10)
    );
    assert_eq!(
        policy.state_len(),
        // Values of nineteen tokens; keys in two blocks of sixteen.
        contract.network().layers * 10 * (19 + 32) + 2 * (3 + 2 + 5)
    );
}
