//! Tests of the rules of a controller's calls.

use crate::support;
use crate::support::assemble::{ACTIONS, OBSERVATION, OBSERVATIONS, parts};
use crate::support::{Image, Memory, Model, Random, Spec, with_controller};
use lads_core::{
    ChannelId, Controller, DType, Data, Decision, EncodeError, FollowError, InputError,
    Instruction, Interval, Noise, Role, StepError,
};
use lads_image::records::{Beyond, NoiseRule, SelectionRule};

fn tiny() -> Model {
    Model::random(Spec::TINY, 11)
}

fn demonstration<'d>(observations: &'d [f32], actions: &'d [f32]) -> [(ChannelId, Data<'d>); 2] {
    [
        (ChannelId(OBSERVATIONS), Data::F32(observations)),
        (ChannelId(ACTIONS), Data::F32(actions)),
    ]
}

fn observed(observation: &[f32]) -> [(ChannelId, Data<'_>); 1] {
    [(ChannelId(OBSERVATION), Data::F32(observation))]
}

#[test]
fn following_an_index_repeats_the_step_and_disturbs_nothing() {
    let model = tiny();
    let image = parts(&model).image();
    let policy = image.policy();
    assert!(policy.follows() && policy.encodes());
    let mut undisturbed = Memory::for_policy(&policy);
    let mut reference = undisturbed.controller(&policy);
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    let (mut random, mut action, mut alone) = (Random(9), [0.0; 2], [0.0; 2]);
    // No instruction is needed.
    assert_eq!(
        controller.follow(&observed(&[0.1; 3]), 4, &mut alone),
        Ok(())
    );
    for controller in [&mut controller, &mut reference] {
        controller
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
    }
    for _ in 0..2 * model.spec.steps {
        let observation = random.vec(3, 1.0);
        controller
            .follow(&observed(&observation), 4, &mut alone)
            .expect("there is such an index");
        for (&got, expected) in alone.iter().zip(model.act(&observation, 4)) {
            assert!((f64::from(got) - expected).abs() < 1e-5);
        }
        let report = controller.step(&observation, &mut action);
        let mut wanted = [0.0; 2];
        assert_eq!(report, reference.step(&observation, &mut wanted));
        assert_eq!(action, wanted);
        let index = report
            .expect("the observation is accepted")
            .selected
            .expect("it selects")
            .index;
        controller
            .follow(&observed(&observation), index, &mut alone)
            .expect("there is such an index");
        assert_eq!(alone, action);
        assert_eq!(controller.scores(), reference.scores());
        assert_eq!(controller.last_action(), action);
    }
    let mut refused = |inputs: &[(ChannelId, Data)], index, action: &mut [f32]| {
        controller
            .follow(inputs, index, action)
            .expect_err("it is refused")
    };
    let sound = observed(&[0.0; 3]);
    assert_eq!(
        refused(&sound, 5, &mut alone),
        FollowError::Index { got: 5, count: 5 }
    );
    assert_eq!(
        refused(&sound, 0, &mut []),
        FollowError::ActionLength { got: 0, needed: 2 }
    );
    let not_finite = InputError::NotFinite {
        channel: OBSERVATION,
        index: 0,
    };
    assert_eq!(
        refused(&observed(&[f32::NAN; 3]), 0, &mut alone),
        FollowError::Input(not_finite)
    );
    let missing = InputError::Missing {
        channel: OBSERVATION,
    };
    assert_eq!(refused(&[], 0, &mut alone), FollowError::Input(missing));
    assert_eq!(alone, action);

    let image = support::shapes::queue().image();
    let refused = with_controller(&image, |controller| {
        controller.follow(&observed(&[0.0; 2]), 0, &mut [0.0; 2])
    });
    assert_eq!(refused, Err(FollowError::NotOffered));
}

#[test]
fn a_full_context_can_refuse() {
    let mut parts = parts(&tiny());
    parts.contract.beyond = Beyond::Refuse;
    with_controller(&parts.image(), |controller| {
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
    });
}

#[test]
fn what_was_executed_goes_into_the_context() {
    let image = parts(&tiny()).image();
    let scores = |executed: Option<[f32; 2]>| {
        with_controller(&image, |controller| {
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
            (controller.scores().to_vec(), returned)
        })
    };
    let (plain, actions) = scores(None);
    assert_ne!(plain, scores(Some([0.9, -0.9])).0);
    // Beyond the limits is at the limits.
    assert_eq!(scores(Some([1.0, -1.0])).0, scores(Some([5.0, -7.0])).0);
    // Saying what was returned changes nothing.
    assert_eq!(actions[0], actions[1]);
    assert_eq!(plain, scores(Some(actions[0])).0);
}

/// Returns the indices and actions of an episode with this decision rule.
fn episode(image: &Image, decision: Decision) -> (Vec<u32>, Vec<f32>) {
    with_controller(image, |controller| {
        controller.set_decision(decision);
        let mut random = Random(1);
        let (mut indices, mut actions) = (Vec::new(), Vec::new());
        for _ in 0..20 {
            let mut action = [0.0; 2];
            let report = controller
                .step(&random.vec(3, 1.0), &mut action)
                .expect("the step is sound");
            indices.extend(report.selected.map(|selected| selected.index));
            actions.extend(action);
        }
        (indices, actions)
    })
}

/// The contract's own temperature counts, and 1 where it only says argmax.
#[test]
fn sampling_is_at_the_temperature_of_the_contract() {
    let mut parts = parts(&tiny());
    parts.contract.temperature = 3.0;
    for (selection, temperature) in [(SelectionRule::Argmax, 1.0), (SelectionRule::Sample, 3.0)] {
        parts.contract.selection = selection;
        let sampling = parts.image().policy().contract().sampling(7);
        let seed = 7;
        assert_eq!(sampling, Decision::Sample { temperature, seed });
    }
}

#[test]
fn sampling_is_a_function_of_the_seed() {
    let image = parts(&tiny()).image();
    let rule = |temperature, seed| Decision::Sample { temperature, seed };
    let sample = |seed| episode(&image, rule(3.0, seed));
    assert_eq!(sample(1), sample(1));
    assert!((2..6).any(|seed| sample(seed).0 != sample(1).0));
    // Random numbers are used up: the first decision of each episode is another draw.
    let draws: Vec<_> = with_controller(&image, |controller| {
        controller.set_decision(rule(10.0, 1));
        let mut draw = || {
            controller.reset();
            controller
                .step(&[0.1; 3], &mut [0.0; 2])
                .expect("the step is sound")
                .selected
                .map(|x| x.index)
        };
        (0..30).map(|_| draw()).collect()
    });
    assert!(
        (0..5).all(|index| draws.contains(&Some(index))),
        "{draws:?}"
    );
    // The contract's own rules are what a new controller starts with.
    let mut parts = parts(&tiny());
    let contract = &mut parts.contract;
    (
        contract.selection,
        contract.temperature,
        contract.selection_seed,
    ) = (SelectionRule::Sample, 3.0, 1 << 40);
    (contract.noise, contract.noise_seed) = (NoiseRule::Seeded, 1 << 50);
    let rules = with_controller(&parts.image(), |controller| {
        (controller.decision(), controller.noise())
    });
    assert_eq!(rules, (rule(3.0, 1 << 40), Noise::Seeded { seed: 1 << 50 }));
}

#[test]
fn without_an_instruction_there_is_no_step() {
    let image = parts(&tiny()).image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    let mut action = [0.5; 2];
    assert_eq!(controller.scores(), [0.0; 5]);
    for _ in 0..2 {
        assert!(!controller.is_instructed());
        assert_eq!(
            controller.step(&[0.0; 3], &mut action),
            Err(StepError::NoInstruction)
        );
        controller.reset();
    }
    assert_eq!(action, [0.5; 2]);
}

#[test]
fn demonstrations_are_encoded_to_the_nearest_plan() {
    let model = tiny();
    let sound = parts(&model);
    let encode = |controller: &mut Controller, observations: &[f32], actions: &[f32]| {
        controller.encode(&demonstration(observations, actions))
    };
    let image = sound.image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    let mut random = Random(21);
    let mut seen = std::collections::BTreeSet::new();
    for _ in 0..50 {
        let (observations, actions) = (random.vec(9, 1.0), random.vec(6, 1.0));
        let expected = model.encode(&observations, &actions) as u32;
        assert_eq!(
            encode(&mut controller, &observations, &actions),
            Ok(expected)
        );
        seen.insert(expected);
    }
    assert!(seen.len() > 1, "one plan for everything proves nothing");
    let length = |channel, got, needed| {
        Err(EncodeError::Input(InputError::Length {
            channel,
            got,
            needed,
        }))
    };
    assert_eq!(
        encode(&mut controller, &[0.0; 8], &[0.0; 6]),
        length(OBSERVATIONS, 8, 9)
    );
    assert_eq!(
        encode(&mut controller, &[0.0; 9], &[0.0; 7]),
        length(ACTIONS, 7, 6)
    );
    let not_finite = InputError::NotFinite {
        channel: ACTIONS,
        index: 0,
    };
    assert_eq!(
        encode(&mut controller, &[0.0; 9], &[f32::NAN; 6]),
        Err(EncodeError::Input(not_finite))
    );

    let mut without = sound;
    without.calls.pop();
    without.entries.pop();
    let without = without.sealed();
    let refused = with_controller(&without.image(), |controller| {
        encode(controller, &[0.0; 9], &[0.0; 6])
    });
    assert_eq!(refused, Err(EncodeError::NoEncoder));
}

#[test]
fn the_contract_says_what_was_written() {
    let model = tiny();
    let mut parts = parts(&model);
    parts.channels[4].reference = parts.text("where the joint is");
    parts.elements[4].joint = parts.text("elbow");
    (parts.elements[4].scale, parts.elements[4].offset) = (2.0, -0.5);
    let image = parts.with_golden(10).image();
    let policy = image.policy();
    assert!(policy.checksum_matches());
    let contract = policy.contract();
    assert_eq!(
        (contract.family(), contract.environment_id()),
        ("lads", "test")
    );
    assert_eq!(
        (contract.environment_version(), contract.bundle_sha256()),
        ("1", "cafe")
    );
    assert_eq!((contract.observation_len(), contract.action_len()), (3, 2));
    assert_eq!(
        (
            contract.words_len(),
            contract.word_dim(),
            contract.context_steps()
        ),
        (4, 4, Some(8))
    );
    assert_eq!(contract.control_period_s(), 0.08);
    let channels: Vec<_> = contract
        .channels()
        .map(|c| (c.name(), c.role(), c.dtype(), c.len()))
        .collect();
    assert_eq!(
        channels,
        [
            ("observation", Role::Observation, DType::F32, 3),
            ("words", Role::Instruction, DType::F32, 16),
            ("observations", Role::Demonstration, DType::F32, 9),
            ("actions", Role::Demonstration, DType::F32, 6),
            ("action", Role::Action, DType::F32, 2),
        ]
    );
    assert_eq!(
        contract
            .find("actions")
            .map(|channel| channel.shape().to_vec()),
        Some(vec![3, 2])
    );
    assert!(contract.find("joint").is_none());
    let element = contract.observation().element(2).expect("there are three");
    assert_eq!(
        (element.name, element.unit, element.joint, element.scale),
        ("observation2", "rad", "", 1.0)
    );
    assert_eq!(contract.observation().element(3), None);
    let element = contract.action().element(1).expect("there are two");
    assert_eq!(
        (element.name, element.joint, element.scale, element.offset),
        ("action1", "elbow", 2.0, -0.5)
    );
    assert_eq!(contract.action().reference(), "where the joint is");
    // The two ways to the limits agree.
    for (channel, limit) in [(contract.observation(), 3.0), (contract.action(), 1.0)] {
        let limits = vec![
            Interval {
                min: -limit,
                max: limit
            };
            channel.len()
        ];
        assert_eq!(channel.limits().collect::<Vec<_>>(), limits);
        assert_eq!(
            channel
                .elements()
                .map(|element| element.limits)
                .collect::<Vec<_>>(),
            limits
        );
    }
    let known: Vec<_> = contract
        .instructions()
        .map(|known| (known.id, known.text))
        .collect();
    assert_eq!(known, [("id0", "instruction 0"), ("id1", "instruction 1")]);
    assert_eq!(
        contract.instruction(1).map(|known| known.words),
        Some(&model.instructions[1][..])
    );
    assert_eq!(contract.instruction(2), None);
    let golden = policy.golden().expect("there is one");
    assert_eq!(
        (golden.len(), golden.instruction(), golden.steps().count()),
        (10, Some(1), 10)
    );
    // Values of nineteen tokens, keys in two blocks of sixteen; twice logits, plan and action.
    assert_eq!(
        policy.state_len(),
        model.spec.layers * 10 * (19 + 32) + 2 * (5 + 3 + 2)
    );
}
