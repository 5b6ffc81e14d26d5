//! Tests episodes of instructions whose word embeddings are not the table's, in the small environment.

#[path = "common/bench.rs"]
mod bench;

use std::sync::atomic::AtomicBool;

use bench::{Bench, DESCRIPTION, tiny_contract, tiny_policy};
use lads_core::{Decision, Isa, Policy};
use lads_sim::evaluate::{Assignment, Evaluated, Evaluation, Setup};
use lads_sim::results;
use lads_sim::rollout::Actor;
use lads_sim::spoken::{FREE, Sentence, SubTaskError, WordBook, nearest};

fn run(policy: &Policy<'_>, assignments: &[Assignment], words: Option<&WordBook>) -> Evaluated {
    let evaluation = Evaluation {
        policy: *policy,
        contract: tiny_contract(),
        assignments,
        episodes: 3,
        seed: 1,
        decision: Decision::Argmax,
        actor: Actor::Policy,
        isa: Isa::detect(),
        threads: 1,
        setup: Setup {
            words,
            ..Setup::default()
        },
    };
    let open = || Box::new(Bench::new(DESCRIPTION)) as _;
    let stop = AtomicBool::new(false);
    evaluation.run(&open, &stop, &|| {}).unwrap()
}

fn sentence(sub_tasks: Option<&str>) -> Result<Sentence, SubTaskError> {
    Sentence::new("say it", sub_tasks, &Bench::new(DESCRIPTION))
}

#[test]
fn the_words_of_the_book_are_heard_instead_of_the_tables() {
    let policy = tiny_policy();
    let contract = policy.contract();
    let of = |instruction| Assignment {
        instruction,
        commanded: vec![0, 1, 2],
        max_steps: 40,
    };
    let plain = run(&policy, &[of(0)], None).episodes;
    let mut book = WordBook::default();
    book.set(0, contract.instruction(0).unwrap().words.to_vec());
    assert_eq!(run(&policy, &[of(0)], Some(&book)).episodes, plain);
    // Words that the table has for no instruction lead elsewhere.
    let opposite = contract.instruction(0).unwrap().words.iter().map(|x| -x);
    book.set(0, opposite.collect());
    assert_ne!(run(&policy, &[of(0)], Some(&book)).episodes, plain);
}

#[test]
fn a_sentence_that_commands_nothing_lasts_its_full_time_and_has_no_rates() {
    let policy = tiny_policy();
    let (contract, environment) = (policy.contract(), Bench::new(DESCRIPTION));
    let known = contract.instruction(1).unwrap();
    let mut book = WordBook::default();
    book.set(contract.instruction_count() as u32, known.words.to_vec());
    let heard = nearest(contract, known.words).unwrap();
    assert_eq!(heard.0, 1);
    assert!((heard.1 - 1.0).abs() < 1e-6);

    let silent = sentence(None).unwrap();
    let assignment = silent.assignment(tiny_contract(), &environment);
    let assignments = [assignment];
    let episodes = run(&policy, &assignments, Some(&book)).episodes;
    assert!(episodes[0].iter().all(|e| e.steps == 40 && !e.success));
    let watched = DESCRIPTION.sub_tasks;
    let result = results::of_instruction(&silent.asked(), watched, &episodes[0]);
    assert_eq!((result.id.as_str(), result.text.as_str()), (FREE, "say it"));
    assert_eq!(result.score.episodes, 3);
    assert_eq!(result.score.full_success, None);
    assert_eq!(result.score.k_rate, [None; 4]);
    let completions = episodes[0].iter().map(|e| e.completions.len());
    assert_eq!(result.score.un_instructed, completions.sum::<usize>());
    assert!(result.runs.iter().all(|run| run.success.is_none()));
}

#[test]
fn a_sentence_is_judged_by_the_sub_tasks_that_are_named() {
    let environment = Bench::new(DESCRIPTION);
    let judged = sentence(Some(" lamp, drawer,lamp ")).unwrap();
    assert_eq!(judged.asked().sub_tasks, ["lamp", "drawer"]);
    assert_eq!(
        judged.assignment(tiny_contract(), &environment).commanded,
        [1, 0]
    );
    assert_eq!(
        sentence(Some(" , ")),
        Err(SubTaskError::None {
            known: "drawer, lamp, lever".into()
        })
    );
    let unknown = sentence(Some("lamp, lantern")).unwrap_err().to_string();
    assert!(unknown.contains("'lantern'") && unknown.contains("drawer, lamp, lever"));
}
