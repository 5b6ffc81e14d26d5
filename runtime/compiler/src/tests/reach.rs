//! Tests that an integer that can lie beyond the last row of a table is refused when the policy is
//! compiled.

use base64::Engine as _;
use prost::Message;
use safetensors::{Dtype, tensor::TensorView};

use super::models::{ENTRY, Small};
use crate::bundle::Bundle;
use crate::compile::compile;
use crate::graph::{Dim, Type};
use crate::onnx::{ModelProto, StringStringEntryProto};

/// Makes a plain policy that adds row `gait` of a table of three rows to its observation.
fn by_gait(limits: &str) -> Vec<u8> {
    let small = Small::new()
        .input("observation", &[1, 2])
        .input_dims("gait", Type::I64, &[Dim::of(1)])
        .random("table", &[3, 2])
        .node("Gather", &["table", "gait"], &["row"], &[])
        .node("Add", &["observation", "row"], &["action"], &[])
        .output("action", &[1, 2]);
    let elements = r#"[{"name": "a", "unit": "1", "min": -9, "max": 9}, {"name": "b", "unit": "1", "min": -9, "max": 9}]"#;
    let contract = format!(
        r#"{{"version": 2, "family": {{"kind": "plain"}}, "environment": {{"id": "test", "version": "1"}}, "control_period_s": 0.1, "provenance": {{}},
            "channels": [{{"name": "observation", "role": "observation", "dtype": "f32", "shape": [2], "elements": {elements}}},
                         {{"name": "gait", "role": "observation", "dtype": "i32", "shape": [1]{limits}}},
                         {{"name": "action", "role": "action", "dtype": "f32", "shape": [2], "elements": {elements}}}]}}"#
    );
    let zeros = [0; 8];
    let tensor = |dtype, shape: &[usize], bytes: usize| {
        TensorView::new(dtype, shape.to_vec(), &zeros[..bytes]).expect("as long as its shape")
    };
    let tensors = [
        ("channel.observation", tensor(Dtype::F32, &[1, 2], 8)),
        ("channel.gait", tensor(Dtype::I32, &[1, 1], 4)),
        ("actions", tensor(Dtype::F32, &[1, 2], 8)),
    ];
    let tolerance = [("tolerance".to_owned(), "9".to_owned())].into();
    let golden = safetensors::serialize(tensors, Some(tolerance)).expect("it serializes");
    let golden = base64::engine::general_purpose::STANDARD.encode(golden);
    let mut model = small.model(17);
    for (key, value) in [("lads.contract", contract), ("lads.golden", golden)] {
        model.metadata_props.push(StringStringEntryProto {
            key: key.into(),
            value,
        });
    }
    let rename = |name: &mut String| *name = name.replace(ENTRY, "policy/act");
    let graph = model.graph.as_mut().expect("a graph");
    let values = graph.input.iter_mut().chain(&mut graph.output);
    values.for_each(|value| rename(&mut value.name));
    graph
        .initializer
        .iter_mut()
        .for_each(|tensor| rename(&mut tensor.name));
    for node in &mut graph.node {
        node.input
            .iter_mut()
            .chain(&mut node.output)
            .for_each(rename);
    }
    model.encode_to_vec()
}

#[test]
fn an_integer_of_the_caller_stays_inside_its_table() {
    let compiled = |limits: &str| {
        let bundle = Bundle::from_bytes(&by_gait(limits)).unwrap_or_else(|error| panic!("{error}"));
        compile(&bundle)
            .map(|_| ())
            .map_err(|error| error.to_string())
    };
    assert_eq!(compiled(r#", "min": 0, "max": 2"#), Ok(()));
    for (limits, said) in [
        (r#", "min": 0, "max": 3"#, "row 3 when channel `gait`"),
        (r#", "min": -1, "max": 2"#, "row -1 when channel `gait`"),
        ("", "channel `gait` (fields `min` and `max`)"),
    ] {
        let error = compiled(limits).expect_err(limits);
        assert!(
            error.contains(said) && error.contains("policy/act"),
            "{error}"
        );
    }
}

#[test]
fn an_index_that_is_selected_stays_inside_the_codebook() {
    let tiny = include_bytes!("../../tests/data/tiny.onnx");
    let mut model = ModelProto::decode(&tiny[..]).expect("a model");
    let graph = model.graph.as_mut().expect("a graph");
    let lookup = graph
        .node
        .iter()
        .find(|node| {
            node.output
                .iter()
                .any(|name| name.starts_with("codebook/lookup/"))
        })
        .expect("the codebook's lookup");
    let table = lookup.input[0].clone();
    let table = graph
        .initializer
        .iter_mut()
        .find(|tensor| tensor.name == table);
    let table = table.expect("the codebook");
    let bytes = table.raw_data.len() / table.dims[0] as usize;
    table.dims[0] -= 1;
    table.raw_data.truncate(table.dims[0] as usize * bytes);
    let bundle =
        Bundle::from_bytes(&model.encode_to_vec()).unwrap_or_else(|error| panic!("{error}"));
    let error = compile(&bundle).expect_err("a row is missing").to_string();
    assert!(
        error.contains("codebook/lookup") && error.contains("`family.codebook.size`"),
        "{error}"
    );
}
