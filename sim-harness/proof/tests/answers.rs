//! Tests how a policy's answers to a reference's questions are judged: what counts, what is harmless, and what is left to the reader.

use std::path::Path;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use lads_proof::answers::{Answers, NOISE_FACTOR, Replay, Reply};
use lads_proof::reference::Reference;
use serde_json::{Value, json};

const STEPS: usize = 6;
const HORIZON: usize = 2;
const PLANS: [u32; 3] = [1, 0, 2];
const LOGITS: [[f32; 3]; 3] = [[0.0, 2.0, 1.0], [3.0, 0.5, 1.0], [-1.0, 0.0, 0.5]];

fn text<T: Copy, const N: usize>(numbers: &[T], bytes: fn(T) -> [u8; N]) -> String {
    STANDARD.encode(
        numbers
            .iter()
            .flat_map(|&number| bytes(number))
            .collect::<Vec<_>>(),
    )
}

/// Makes a reference of one instruction and one traced episode of one observation and one action.
fn file() -> Value {
    let numbers: Vec<f32> = (0..STEPS).map(|step| step as f32).collect();
    let states: Vec<f64> = vec![0.0; STEPS];
    json!({
        "format": "lads-reference",
        "format_version": 2,
        "bundle_sha256": "",
        "purpose_sha256": "",
        "environment": {"id": "bench", "version": "1"},
        "seed": 0,
        "noise": "none",
        "horizon": HORIZON,
        "episodes_per_instruction": 1,
        "traced_episodes": 1,
        "weights_from": "the run's checkpoint",
        "words_from": "the language encoder",
        "contract": {"decision": {"rule": "argmax"}},
        "versions": {},
        "instructions": [{"id": "a", "text": "go", "episodes": [{
            "episode": 0, "steps": STEPS, "success": true, "completions": [], "final_state": [0.0],
            "plans": PLANS, "margins": [1.0, 2.0, 0.5], "decided_at": [0, 2, 4],
            "trace": {
                "observations": text(&numbers, f32::to_le_bytes),
                "actions": text(&numbers, f32::to_le_bytes),
                "states": text(&states, f64::to_le_bytes),
                "logits": text(LOGITS.as_flattened(), f32::to_le_bytes),
                "encoded": [1, 0, 2],
                "encoded_margins": [0.5, 0.5, 1e-5],
            },
        }]}],
    })
}

fn read(file: &Value) -> Reference {
    Reference::read(file.to_string().as_bytes(), Path::new("r.json")).unwrap()
}

/// Makes the answers of the reference's own policy.
fn own() -> Replay {
    let replies = (0..STEPS).map(|step| Reply {
        decided: step.is_multiple_of(HORIZON),
        plan: Some(PLANS[step / HORIZON]),
        logits: if step.is_multiple_of(HORIZON) {
            LOGITS[step / HORIZON].to_vec()
        } else {
            Vec::new()
        },
        action: vec![step as f32],
        ..Reply::default()
    });
    Replay {
        replies: replies.collect(),
        encoded: Some(vec![1, 0, 2]),
        ..Replay::default()
    }
}

fn judged(change: impl Fn(&mut Replay)) -> Answers {
    let mut replay = own();
    change(&mut replay);
    Answers::judge(&read(&file()), &[replay], None).0
}

fn difference(answers: &Answers, part: &str) {
    let found = answers
        .first_difference
        .as_ref()
        .map(ToString::to_string)
        .unwrap_or_default();
    assert!(found.contains(part), "'{part}' is not in '{found}'");
}

#[test]
fn the_same_answers_are_no_difference() {
    let answers = judged(|_| {});
    assert_eq!((answers.differing_episodes, answers.renumbered), (0, false));
    assert_eq!(
        (
            answers.compared_steps,
            answers.compared_decisions,
            answers.compared_segments,
            answers.longest_episode
        ),
        (STEPS, 3, 3, STEPS)
    );
}

#[test]
fn logits_are_judged_up_to_a_constant() {
    let all = |by: fn(f32) -> f32| {
        move |replay: &mut Replay| {
            replay
                .replies
                .iter_mut()
                .flat_map(|it| &mut it.logits)
                .for_each(|x| *x = by(*x));
        }
    };
    let shifted = judged(all(|x| x + 7.0));
    assert_eq!(
        (shifted.differing_episodes, shifted.largest_logit_difference),
        (0, 0.0)
    );
    // The head times ten: the same plans, and everything that samples or monitors is off.
    let scaled = judged(all(|x| x * 10.0));
    assert!(scaled.largest_logit_difference > 10.0);
    difference(&scaled, "a logit is off by");
    difference(
        &judged(|replay| replay.replies[2].logits[1] += 0.05),
        "step 2: a logit is off by",
    );
    difference(
        &judged(|replay| replay.replies[0].logits[1] = f32::NAN),
        "a logit is off by",
    );
    difference(
        &judged(|replay| replay.replies[0].logits.truncate(2)),
        "2 logits, the reference 3",
    );
}

#[test]
fn plans_that_are_vectors_are_judged_element_by_element() {
    // A policy that selects nothing, two elements in each plan.
    let mut file = file();
    file["horizon"] = Value::Null;
    let episode = &mut file["instructions"][0]["episodes"][0];
    for key in ["plans", "margins", "decided_at"] {
        episode[key] = json!([]);
    }
    let plans: Vec<f32> = (0..2 * STEPS).map(|element| element as f32 / 8.0).collect();
    let trace = episode["trace"].as_object_mut().unwrap();
    trace.retain(|key, _| !key.starts_with("encoded"));
    episode["trace"]["logits"] = json!("");
    episode["trace"]["plan_vectors"] = text(&plans, f32::to_le_bytes).into();
    let reference = read(&file);
    let judged = |change: fn(&mut Reply)| {
        let mut replay = own();
        for (reply, plan) in replay.replies.iter_mut().zip(plans.chunks(2)) {
            *reply = Reply {
                plan_vector: plan.to_vec(),
                action: reply.action.clone(),
                ..Reply::default()
            };
        }
        change(&mut replay.replies[3]);
        Answers::judge(&reference, &[replay], None).0
    };
    let same = judged(|_| {});
    assert_eq!(
        (same.differing_episodes, same.compared_plan_vectors),
        (0, STEPS)
    );
    let mut damaged = file.clone();
    let trace = &mut damaged["instructions"][0]["episodes"][0]["trace"];
    trace["plan_vectors"] = text(&[f32::NAN; 2 * STEPS], f32::to_le_bytes).into();
    let error = Reference::read(damaged.to_string().as_bytes(), Path::new("r.json"));
    assert!(error.unwrap_err().to_string().contains("not finite"));
    let near = judged(|reply| reply.plan_vector[1] += 1e-4);
    assert!(near.differing_episodes == 0 && near.largest_plan_difference > 9e-5);
    let far = "step 3: an element of the plan is off by";
    difference(&judged(|reply| reply.plan_vector[1] += 0.01), far);
    difference(&judged(|reply| reply.plan_vector[0] = f32::NAN), far);
    difference(
        &judged(|reply| reply.plan_vector.clear()),
        "step 3: the policy's plan has 0 elements, the reference's 2",
    );
}

#[test]
fn a_consistent_renumbering_of_the_plans_is_harmless() {
    // The reference's plans 0, 1, 2 are the run's 2, 0, 1.
    let number = |plan: u32| [2, 0, 1][plan as usize];
    let renumber = |replay: &mut Replay| {
        for reply in &mut replay.replies {
            reply.plan = reply.plan.map(number);
            if let [a, b, c] = reply.logits[..] {
                reply.logits = vec![b, c, a];
            }
        }
        replay
            .encoded
            .iter_mut()
            .flatten()
            .for_each(|plan| *plan = number(*plan));
    };
    let answers = judged(renumber);
    assert!(
        answers.renumbered && answers.differing_episodes == 0,
        "{answers:?}"
    );
    // Only the logits: the codes are in the old order, so other plans are followed.
    let torn = judged(|replay| {
        renumber(replay);
        replay
            .replies
            .iter_mut()
            .for_each(|reply| reply.action[0] += 0.5);
    });
    difference(&torn, "action element 0");
}

#[test]
fn an_encoder_that_sees_other_plans_is_a_difference_but_for_close_calls() {
    difference(
        &judged(|replay| replay.encoded = Some(vec![1, 1, 2])),
        "sees plan 1 in segment 1, the reference's 0",
    );
    let close = judged(|replay| replay.encoded = Some(vec![1, 0, 0]));
    assert_eq!((close.differing_segments, close.differing_episodes), (0, 0));
    assert_eq!(judged(|replay| replay.encoded = None).compared_segments, 0);
    // An encoder that refuses the second segment.
    let refused = judged(|replay| replay.encoded = Some(vec![1]));
    assert_eq!(
        [refused.compared_segments, refused.differing_segments],
        [3, 2]
    );
    difference(&refused, "sees a plan in 1 of 3 segments");
}

#[test]
fn float_noise_that_the_reference_shows_is_allowed() {
    let off = |replay: &mut Replay| {
        replay.replies[3].action[0] += 3e-4;
        replay.replies[2].logits[0] += 0.03;
    };
    difference(&judged(off), "a logit is off by");
    let mut noisy = file();
    noisy["float_noise"] = json!({"relative": 1e-6, "action": 2e-4, "logit": 1e-2});
    let mut replay = own();
    off(&mut replay);
    let answers = Answers::judge(&read(&noisy), &[replay], Some(1e-5)).0;
    assert_eq!(answers.first_difference, None);
    assert_eq!(
        (answers.action_tolerance, answers.logit_tolerance),
        (NOISE_FACTOR * 2e-4, Some(NOISE_FACTOR * 1e-2))
    );
}

#[test]
fn a_bundle_does_not_set_its_own_bar() {
    let answers = Answers::judge(&read(&file()), &[own()], Some(0.5)).0;
    assert_eq!(answers.action_tolerance, 1e-4);
}

/// Case: a context that is not a multiple of the horizon, so that the restart decides at a step that is on no grid.
#[test]
fn decisions_off_the_grid_are_judged_where_they_were() {
    let mut restarted = file();
    restarted["instructions"][0]["episodes"][0]["decided_at"] = json!([0, 2, 3]);
    let reference = read(&restarted);
    let mut replay = own();
    for (step, plan) in [(0, 1), (1, 1), (2, 0), (3, 2), (4, 2), (5, 2)] {
        let reply = &mut replay.replies[step];
        (reply.plan, reply.decided, reply.logits) = (Some(plan), false, Vec::new());
    }
    for (number, step) in [0, 2, 3].into_iter().enumerate() {
        replay.replies[step].decided = true;
        replay.replies[step].logits = LOGITS[number].to_vec();
    }
    assert_eq!(
        Answers::judge(&reference, &[replay], None)
            .0
            .first_difference,
        None
    );
    difference(
        &Answers::judge(&reference, &[own()], None).0,
        "step 3: the policy keeps its plan where the reference decides",
    );
}

#[test]
fn a_refusal_is_a_difference() {
    let answers = judged(|replay| {
        replay.replies.truncate(4);
        replay.refused = Some("the observation is refused: full".to_owned());
    });
    difference(&answers, "step 4: the observation is refused");
}

/// Asserts that a changed reference is refused with this text.
#[track_caller]
fn refused(change: &dyn Fn(&mut Value), part: &str) {
    let mut file = file();
    change(&mut file);
    let error = Reference::read(file.to_string().as_bytes(), Path::new("r.json"))
        .unwrap_err()
        .to_string();
    assert!(error.contains(part) && error.contains("r.json"), "{error}");
}

/// Changes the one episode.
fn episode(change: fn(&mut Value)) -> impl Fn(&mut Value) {
    move |file| change(&mut file["instructions"][0]["episodes"][0])
}

#[test]
fn numbers_that_no_episode_has_are_refused() {
    let no_logit = "has no logit";
    refused(&episode(|it| it["plans"] = json!([1, 999, 2])), no_logit);
    refused(
        &episode(|it| it["trace"]["encoded"] = json!([1, 0, 999])),
        no_logit,
    );
    // More than any memory holds, where the plans come once a period.
    refused(
        &episode(|it| {
            it["steps"] = json!(10_u64.pow(15));
            it.as_object_mut().unwrap().remove("decided_at");
        }),
        "one per decision",
    );
    refused(
        &episode(|it| it["decided_at"] = json!([0, 2, 2])),
        "one per decision",
    );
    refused(
        &episode(|it| it["margins"] = json!([1.0, -2.0, 0.5])),
        "margin is negative",
    );
    for step in [0, STEPS + 1] {
        refused(
            &|file: &mut Value| {
                let done = json!([{"sub_task": "drawer", "step": step}]);
                file["instructions"][0]["episodes"][0]["completions"] = done;
            },
            "no step of its episode",
        );
    }
    for (noise, said) in [
        (
            json!({"relative": 1e-6, "action": 1e30, "logit": 0.0}),
            "its own actions by 1.0e30",
        ),
        (
            json!({"relative": 1e-6, "action": 0.0, "logit": 9.0}),
            "its own logits by 9",
        ),
        (
            json!({"relative": 1e-6, "action": -1.0, "logit": 0.0}),
            "negative",
        ),
    ] {
        refused(
            &|file: &mut Value| file["float_noise"] = noise.clone(),
            said,
        );
    }
    let segments = "one plan per whole segment";
    refused(
        &episode(|it| it["trace"]["encoded"] = json!([1, 0])),
        segments,
    );
    refused(
        &episode(|it| it["trace"]["encoded_margins"] = json!([0.5])),
        segments,
    );
    for field in ["observations", "actions", "logits"] {
        let mut numbers = [0.0; 9];
        numbers[4] = f32::NAN;
        refused(
            &|file| {
                let trace = &mut file["instructions"][0]["episodes"][0]["trace"];
                trace[field] = json!(text(&numbers, f32::to_le_bytes));
            },
            "not finite",
        );
    }
}

#[test]
fn a_file_that_contradicts_itself_is_refused() {
    refused(
        &|file| file["instructions"][0]["episodes"][0]["decided_at"] = json!([0, 2]),
        "one per decision",
    );
    refused(
        &|file| file["instructions"][0]["episodes"][0]["decided_at"] = json!([0, 2, 9]),
        "one per decision",
    );
    refused(
        &|file| file["instructions"][0]["episodes"][0]["trace"]["logits"] = json!("AAAAAAAAAAA="),
        "logits",
    );
    refused(
        &|file| file["format_version"] = json!(3),
        "lads-reference 3",
    );
    // The first version has neither contract nor logits: it is read, and less can be proved by it.
    let mut old = file();
    old["format_version"] = json!(1);
    old["instructions"][0]["episodes"][0]["trace"]
        .as_object_mut()
        .unwrap()
        .retain(|key, _| !key.starts_with("encoded") && key != "logits");
    let answers = Answers::judge(&read(&old), &[own()], None).0;
    assert_eq!(
        (
            answers.compared_decisions,
            answers.compared_segments,
            answers.differing_episodes
        ),
        (0, 0, 0)
    );
}
