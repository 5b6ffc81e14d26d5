//! Tests that warming a controller changes nothing, wherever it happens.

use lads_core::{Controller, Instruction, Policy};
use lads_host::Memory;
use lads_tests::{bundles, compiled};

/// Returns plans, actions and logits of steps over a context's end, with a second instruction on the way.
fn episode(policy: &Policy<'_>, warm: bool) -> Vec<(Option<u32>, Vec<f32>, Vec<f32>)> {
    let mut memory = Memory::of(policy).expect("there is memory");
    let mut controller = memory.controller(policy).unwrap();
    let mut action = vec![0.0; policy.contract().action_len()];
    let golden = policy.golden().unwrap();
    let steps = policy.contract().context_steps().unwrap() + 3;
    let mut seen = Vec::new();
    let pause = |controller: &mut Controller<'_, '_>| {
        if warm {
            controller.warm();
        }
    };
    pause(&mut controller);
    for instruction in [1, 0] {
        controller
            .set_instruction(Instruction::Id(instruction))
            .unwrap();
        let observations = std::iter::repeat_with(|| golden.steps()).flatten();
        for (i, recorded) in observations.take(steps).enumerate() {
            if i % 7 == 0 || i + 5 > steps {
                pause(&mut controller);
            }
            let report = controller
                .step_with(recorded.observations(), &mut action)
                .unwrap();
            let index = report.selected.map(|selected| selected.index);
            seen.push((index, action.clone(), controller.scores().to_vec()));
        }
    }
    seen
}

#[test]
fn warming_changes_nothing() {
    for path in bundles() {
        let image = compiled(&path);
        let policy = Policy::new_checked(image.as_bytes()).unwrap();
        assert!(
            episode(&policy, true) == episode(&policy, false),
            "{}",
            path.display()
        );
    }
}
