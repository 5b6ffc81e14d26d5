//! Tests that a refusal of a controller is described with the names of channel and element.
#![cfg(feature = "compile")]

use std::path::Path;

use lads_core::{ChannelId, Data, InputError, Instruction, StepError};

#[test]
fn the_message_names_channel_and_element() {
    let tiny = Path::new(env!("CARGO_MANIFEST_DIR")).join("../compiler/tests/data/tiny.onnx");
    let mut loaded = lads_host::open(&tiny).unwrap().load().unwrap();
    let mut controller = loaded.controller();
    controller.set_instruction(Instruction::Id(0)).unwrap();
    let policy = *controller.policy();
    let contract = policy.contract();
    let channel = contract.observation();
    let name = channel.name();
    let element = channel.elements().nth(2).map(|it| it.name).unwrap();
    let mut said = |given: &[(ChannelId, Data)]| match controller.step_with(given, &mut [0.0; 3]) {
        Err(StepError::Input(error)) => lads_host::refused(&error, contract),
        other => panic!("{other:?}"),
    };
    let id = channel.id();
    let nan = [0.0, 0.0, f32::NAN, 0.0, 0.0];
    let far = [0.0, 0.0, 1e9, 0.0, 0.0];
    let at = format!("channel `{name}`, element 2 `{element}` is");
    assert_eq!(said(&[(id, Data::F32(&nan))]), format!("{at} not finite"));
    let limits = said(&[(id, Data::F32(&far))]);
    assert!(
        limits.starts_with(&format!("{at} 1000000000, its limits are ")),
        "{limits}"
    );
    assert_eq!(
        said(&[(id, Data::F32(&nan[..4]))]),
        format!("channel `{name}` got 4 elements, the contract says 5")
    );
    assert_eq!(
        said(&[(id, Data::U8(&[0; 5]))]),
        format!("channel `{name}` has elements of another type")
    );
    assert_eq!(said(&[]), format!("channel `{name}` is not given"));
    let unknown = InputError::Missing { channel: 99 };
    assert_eq!(lads_host::refused(&unknown, contract), unknown.to_string());
}
