//! Compares programs with the naive model, which computes everything anew in 64 bits.

mod support;

use support::assemble::assemble;
use support::{Kind, Model, Random, Runner, Spec};

/// Runs control steps beside the naive model, telling both which action was executed, and returns
/// the largest difference of an action.
fn compare(
    model: &Model,
    words: &[f32],
    steps: usize,
    executed: impl Fn(&[f32]) -> Vec<f32>,
) -> f64 {
    let spec = model.spec;
    let policy = assemble(model);
    let mut runner = Runner::new(&policy);
    runner
        .run(Kind::Instruct, &[("words", words)])
        .expect("the words are sound");
    let rows = words.len() / spec.word_dim;
    let mut random = Random(99);
    let (mut observations, mut actions) = (Vec::new(), Vec::<Vec<f32>>::new());
    let mut plan = 0;
    let mut largest = 0.0_f64;
    for step in 0..steps {
        let t = step % spec.steps;
        if t == 0 {
            // The words stay in the cache, the rest of it starts anew.
            runner.past = rows;
            observations.clear();
            actions.clear();
        }
        observations.push(random.vec(spec.observation_len, 1.0));
        let previous = actions.last().cloned().unwrap_or_default();
        let inputs: [(&str, &[f32]); 3] = [
            ("timestep", &[t as f32]),
            ("observation", &observations[t]),
            ("action", &previous),
        ];
        let decides = t.is_multiple_of(spec.horizon);
        let kind = match t {
            0 => Kind::Start,
            _ if decides => Kind::StepDecide,
            _ => Kind::StepRecord,
        };
        runner.run(kind, &inputs).expect("the step is sound");
        if decides {
            let logits = model.logits(words, &observations, &actions);
            for (&logit, expected) in runner.output(kind, "logits").iter().zip(&logits) {
                assert!(
                    (f64::from(logit) - expected).abs() < 1e-4,
                    "step {step}: {logit} against {expected}"
                );
            }
            plan = (0..logits.len())
                .max_by(|&a, &b| logits[a].total_cmp(&logits[b]))
                .expect("there are logits");
            runner
                .run(Kind::Lookup, &[("plan_index", &[plan as f32])])
                .expect("the codebook has the plan");
            assert_eq!(runner.output(Kind::Lookup, "plan"), model.plan(plan));
        }
        let inputs: [(&str, &[f32]); 2] = [
            ("observation", &observations[t]),
            ("plan", model.plan(plan)),
        ];
        runner.run(Kind::Act, &inputs).expect("the act is sound");
        let action = runner.output(Kind::Act, "action");
        for (&got, expected) in action.iter().zip(model.act(&observations[t], plan)) {
            // The naive model clips as the controller does.
            largest = largest.max((f64::from(got.clamp(-1.0, 1.0)) - expected).abs());
        }
        actions.push(executed(&action));
    }
    largest
}

#[test]
fn episodes_equal_the_naive_model() {
    let model = Model::random(Spec::TINY, 11);
    for words in &model.instructions {
        // A full context restarts after the words.
        let largest = compare(&model, words, 2 * model.spec.steps + 2, <[f32]>::to_vec);
        assert!(largest < 1e-5, "actions differ by {largest}");
    }
    let one_word = Random(4).vec(model.spec.word_dim, 1.0);
    compare(&model, &one_word, 5, <[f32]>::to_vec);
}

#[test]
fn the_sizes_of_kitchen_equal_the_naive_model() {
    let spec = Spec {
        steps: 12,
        horizon: 5,
        ..Spec::KITCHEN
    };
    let model = Model::random(spec, 3);
    let largest = compare(&model, &model.instructions[0], 12, <[f32]>::to_vec);
    assert!(largest < 2e-5, "actions differ by {largest}");
}

#[test]
fn the_executed_action_reaches_the_naive_model_too() {
    let model = Model::random(Spec::TINY, 11);
    let other = |action: &[f32]| action.iter().map(|x| 0.5 - x).collect();
    compare(&model, &model.instructions[0], model.spec.steps, other);
}

#[test]
fn an_encoded_horizon_equals_the_naive_model() {
    let model = Model::random(Spec::TINY, 11);
    let policy = assemble(&model);
    let mut runner = Runner::new(&policy);
    let mut random = Random(8);
    let (o, a, h) = (
        model.spec.observation_len,
        model.spec.action_len,
        model.spec.horizon,
    );
    for _ in 0..20 {
        let (observations, actions) = (random.vec(o * h, 1.0), random.vec(a * h, 1.0));
        runner
            .run(
                Kind::Encode,
                &[("observations", &observations), ("actions", &actions)],
            )
            .expect("the horizon is sound");
        let index = runner.output(Kind::Encode, "plan_index");
        assert_eq!(index, [model.encode(&observations, &actions) as f32]);
        assert_eq!(
            runner.output(Kind::Encode, "latent").len(),
            model.spec.plan_len
        );
    }
}
