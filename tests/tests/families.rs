//! Every family of policies, beside ONNX Runtime: random policies of small size, driven by a recorded episode with two instructions,
//! resets and restarts of the context.
//!
//! `python -m lads_exporter random` made the bundles, `python -m lads_exporter episode` the episodes: the exporter's own twin of the
//! schedule calls the entries one by one with ONNX Runtime. The parity tests make them again.

use std::path::{Path, PathBuf};

use lads_compiler::{Bundle, compile};
use lads_core::{ChannelId, Controller, Data, Instruction, Policy, Workspace};
use safetensors::{SafeTensors, tensor::TensorView};

/// Largest difference of an action from ONNX Runtime's.
const TOLERANCE: f32 = 1e-5;

const KINDS: [&str; 10] = [
    "lads",
    "lang_dt",
    "lisa",
    "vae",
    "lcsd",
    "skilldiffuser",
    "history",
    "plain",
    "recurrent",
    "stacked",
];

/// Where the bundles and episodes lie: in this crate, or where the parity tests have just made them.
fn folder() -> PathBuf {
    std::env::var_os("LADS_FAMILIES").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/families"),
        PathBuf::from,
    )
}

fn floats(tensor: &TensorView) -> Vec<f32> {
    tensor
        .data()
        .as_chunks()
        .0
        .iter()
        .map(|&word| f32::from_le_bytes(word))
        .collect()
}

fn integers(tensor: &TensorView) -> Vec<i64> {
    tensor
        .data()
        .as_chunks()
        .0
        .iter()
        .map(|&word| i64::from_le_bytes(word))
        .collect()
}

/// Runs a bundle through its recorded episode.
fn replay(kind: &str) {
    let folder = folder();
    let bundle = Bundle::open(&folder.join(format!("{kind}.onnx")))
        .unwrap_or_else(|error| panic!("{error}"));
    let episode = std::fs::read(folder.join(format!("{kind}.safetensors"))).expect("an episode");
    let episode = SafeTensors::deserialize(&episode).expect("safetensors");
    let image = compile(&bundle).unwrap_or_else(|error| panic!("{kind}: {error}"));
    let policy =
        Policy::new_checked(image.as_bytes()).unwrap_or_else(|error| panic!("{kind}: {error}"));
    let (mut arena, mut state) = (vec![0.0; policy.arena_len()], vec![0.0; policy.state_len()]);
    let workspace = Workspace::new(&policy, &mut arena, &mut state).expect("a workspace");
    let mut controller = Controller::new(policy, workspace);
    controller
        .self_test()
        .unwrap_or_else(|error| panic!("{kind}: {error}"));

    let contract = policy.contract();
    let tensor = |name: &str| {
        episode
            .tensor(name)
            .unwrap_or_else(|_| panic!("{kind}: no tensor {name}"))
    };
    let (events, selected) = (integers(&tensor("event")), integers(&tensor("selected")));
    let actions = floats(&tensor("actions"));
    let noise = episode
        .tensor("noise")
        .map(|tensor| floats(&tensor))
        .unwrap_or_default();
    let channels: Vec<(ChannelId, usize, Vec<f32>)> = contract
        .observations()
        .map(|channel| {
            (
                channel.id(),
                channel.len(),
                floats(&tensor(&format!("channel.{}", channel.name()))),
            )
        })
        .collect();
    let noise_channel = contract
        .channels()
        .find(|channel| channel.role() == lads_core::Role::Noise);
    let mut action = vec![0.0; contract.action_len()];
    let mut instructions = std::collections::HashSet::new();
    let mut restarts = 0;
    for (step, (&event, &expected)) in events.iter().zip(&selected).enumerate() {
        match event {
            -1 => {}
            -2 => controller.reset(),
            id => {
                instructions.insert(id);
                controller
                    .set_instruction(Instruction::Id(id as u32))
                    .expect("an instruction");
            }
        }
        let mut inputs: Vec<(ChannelId, Data)> = channels
            .iter()
            .map(|(id, len, values)| (*id, Data::F32(&values[step * len..][..*len])))
            .collect();
        let len = policy.noise_len();
        if let Some(channel) = &noise_channel {
            inputs.push((channel.id(), Data::F32(&noise[step * len..][..len])));
        }
        let report = controller
            .step_with(&inputs, &mut action)
            .unwrap_or_else(|error| panic!("{kind}, step {step}: {error}"));
        restarts += usize::from(event == -1 && step > 0 && report.timestep == 0);
        let index = report
            .selected
            .map_or(-1, |selected| i64::from(selected.index));
        assert_eq!(index, expected, "{kind}, step {step}: selected index");
        for (i, (&got, &wanted)) in action
            .iter()
            .zip(&actions[step * action.len()..])
            .enumerate()
        {
            let difference = (got - wanted).abs();
            assert!(
                difference <= TOLERANCE,
                "{kind}, step {step}, element {i}: {got}, ONNX Runtime gives {wanted}"
            );
        }
    }
    assert!(events.len() >= 200, "{kind}: {} steps", events.len());
    if contract.instruction_channel().is_some() {
        assert!(
            instructions.len() > 1 && restarts > 0,
            "{kind}: {instructions:?}, {restarts} restarts"
        );
    }
}

macro_rules! kinds {
    ($($name:ident,)*) => { $(
        #[test]
        fn $name() {
            assert!(KINDS.contains(&stringify!($name)));
            replay(stringify!($name));
        }
    )* };
}

kinds! { lads, lang_dt, lisa, vae, lcsd, skilldiffuser, history, plain, recurrent, stacked, }
