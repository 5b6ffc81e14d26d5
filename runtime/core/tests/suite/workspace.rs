//! Tests of a controller's memory: its size, its owner, and its contents beforehand.

use crate::support::assemble::parts;
use crate::support::{Memory, Model, Random, Spec};
use lads_core::{Controller, Instruction, Isa, Workspace};

fn tiny() -> Model {
    Model::random(Spec::TINY, 11)
}

#[test]
fn a_workspace_one_element_too_small_is_refused() {
    let image = parts(&tiny()).image();
    let policy = image.policy();
    let (arena_len, state_len) = (policy.arena_len(), policy.state_len());
    let attempt = |arena: usize, state: usize| {
        let (mut arena, mut state) = (vec![0.0; arena], vec![0.0; state]);
        Workspace::new(&policy, &mut arena, &mut state)
            .map(|_| ())
            .map_err(|e| (e.got, e.needed))
    };
    assert_eq!(attempt(arena_len, state_len), Ok(()));
    assert_eq!(attempt(arena_len + 3, state_len + 5), Ok(()));
    assert_eq!(
        attempt(arena_len - 1, state_len),
        Err((arena_len - 1, arena_len))
    );
    assert_eq!(
        attempt(arena_len, state_len - 1),
        Err((state_len - 1, state_len))
    );
    assert_eq!(attempt(0, 0), Err((0, arena_len)));
}

#[test]
fn a_workspace_of_another_policy_is_refused_by_the_calls() {
    let (small, large) = (
        parts(&tiny()).image(),
        parts(&Model::random(
            Spec {
                steps: 3,
                ..Spec::KITCHEN
            },
            1,
        ))
        .image(),
    );
    for (lender, user) in [(&small, &large), (&large, &small)] {
        let (lender, user) = (lender.policy(), user.policy());
        let mut memory = Memory::for_policy(&lender);
        let workspace = Workspace::new(&lender, &mut memory.arena, &mut memory.state)
            .expect("the memory suffices");
        let mut controller = Controller::new(user, workspace);
        let told = controller.set_instruction(Instruction::Id(0));
        let (o, a) = (
            user.contract().observation_len(),
            user.contract().action_len(),
        );
        let stepped = controller.step(&vec![0.0; o], &mut vec![0.0; a]);
        assert!(told.is_err() || stepped.is_err());
        assert!(stepped.is_err());
    }
}

#[test]
fn what_lies_in_the_memory_beforehand_does_not_matter() {
    let image = parts(&tiny()).image();
    let policy = image.policy();
    let run = |fill: f32| {
        let mut memory = Memory {
            arena: vec![fill; policy.arena_len()],
            state: vec![fill; policy.state_len()],
        };
        let mut controller = memory.controller(&policy);
        controller
            .set_instruction(Instruction::Id(1))
            .expect("the instruction is known");
        let mut action = [0.0; 2];
        (0..9)
            .map(|_| controller.step(&[0.2; 3], &mut action).map(|_| action))
            .collect::<Vec<_>>()
    };
    assert_eq!(run(0.0), run(f32::NAN));
    assert_eq!(run(0.0), run(1e30));
}

/// Runs one kitchen-sized episode on every instruction set and compares the actions bit for bit.
#[test]
fn every_instruction_set_gives_the_same_actions() {
    let image = parts(&Model::random(Spec::KITCHEN, 5)).image();
    let policy = image.policy();
    let episode = |isa: Isa| {
        let mut memory = Memory::for_policy(&policy);
        let workspace = Workspace::new(&policy, &mut memory.arena, &mut memory.state)
            .expect("the memory suffices");
        let mut controller = Controller::with_isa(policy, workspace, isa);
        assert_eq!(controller.isa(), isa);
        controller
            .set_instruction(Instruction::Id(0))
            .expect("there is one");
        let mut random = Random(7);
        let mut bits = Vec::new();
        for _ in 0..50 {
            let observation = random.vec(policy.contract().observation_len(), 1.0);
            let mut action = vec![0.0; policy.contract().action_len()];
            let report = controller
                .step(&observation, &mut action)
                .expect("within limits");
            bits.push(report.selected.expect("it selects").margin.to_bits());
            bits.extend(
                action
                    .iter()
                    .chain(controller.scores())
                    .map(|x| x.to_bits()),
            );
        }
        bits
    };
    let portable = episode(Isa::portable());
    for isa in Isa::all() {
        assert_eq!(episode(isa), portable, "{isa:?}");
    }
    let mut memory = Memory::for_policy(&policy);
    assert_eq!(memory.controller(&policy).isa(), Isa::detect());
}
