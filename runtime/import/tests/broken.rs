//! Tests that broken files, and weights that are not where the model says, are reported by name, and
//! nothing is imported.

mod common;

use common::{Case, HEAD, SENSOR, mirror, model, node, step, value, weight, wide_action};
use lads_compiler::onnx::{AttributeProto, NodeProto, StringStringEntryProto};
use prost::Message as _;

fn external(location: &str, extra: &[(&str, &str)]) -> lads_compiler::onnx::ModelProto {
    let mut policy = model(
        vec![value("obs", &[1, 2])],
        vec![node("MatMul", &["obs", "w"], &["actions"])],
        vec![weight("w", &[2, 2], &[])],
        vec![value("actions", &[1, 2])],
    );
    let tensor = &mut policy.graph.as_mut().expect("a graph").initializer[0];
    tensor.data_location = 1;
    tensor.external_data = std::iter::once(&("location", location))
        .chain(extra)
        .map(|(key, value)| StringStringEntryProto {
            key: (*key).into(),
            value: (*value).into(),
        })
        .collect();
    policy
}

#[test]
fn weights_beside_the_model_are_brought_in_and_never_from_elsewhere() {
    let robot = format!("{HEAD}[[term]]\nname = \"a\"\n{SENSOR}{}", wide_action(2));
    let weights: Vec<u8> = [9.0_f32, 1.0, 2.0, 3.0, 4.0]
        .iter()
        .flat_map(|x| x.to_le_bytes())
        .collect();
    let case = Case::new(
        &external("policy.onnx.data", &[("offset", "4"), ("length", "16")]),
        &robot,
    );
    let told = case.refused();
    assert!(told.contains("`policy.onnx.data`, which is missing"));
    // Nothing else says that the weights should be elsewhere.
    assert!(told.contains("1 thing to settle"), "{told}");
    case.put("policy.onnx.data", &weights);
    let actions = case.actions(&[step(&[&[1.0, 10.0]])]);
    common::close(&actions[0], &[31.0, 42.0]);
    case.put("policy.onnx.data", &weights[..19]);
    assert!(case.refused().contains("needs bytes 4 to 20"));

    for (location, extra, said) in [
        ("../policy.onnx.data", &[][..], "outside the model's folder"),
        ("/etc/passwd", &[], "outside the model's folder"),
        (
            "policy.onnx.data",
            &[("length", "8")],
            "has 8 bytes of external data, its type and shape need 16",
        ),
        (
            "policy.onnx.data",
            &[("offset", "18446744073709551615")],
            "needs bytes 18446744073709551615",
        ),
        ("policy.onnx.data", &[("offset", "-1")], "not a number"),
        (".", &[], "is not a file"),
    ] {
        let case = Case::new(&external(location, extra), &robot);
        case.put("policy.onnx.data", &weights);
        let told = case.refused();
        assert!(told.contains(said), "{location}: {told}");
    }
    #[cfg(unix)]
    {
        let outside = tempfile::NamedTempFile::new().expect("a file");
        let case = Case::new(&external("link", &[]), &robot);
        std::os::unix::fs::symlink(outside.path(), case.path("link")).expect("a link");
        assert!(case.refused().contains("leads out of the model's folder"));
    }
}

#[test]
fn broken_graphs_are_refused_by_name() {
    let robot = format!("{HEAD}[[term]]\nname = \"a\"\n{SENSOR}{}", wide_action(1));
    let policy = |nodes, weights| {
        model(
            vec![value("obs", &[1, 1])],
            nodes,
            weights,
            vec![value("actions", &[1, 1])],
        )
    };
    let cycle = vec![
        node("Add", &["obs", "b"], &["a"]),
        node("Add", &["a", "a"], &["b"]),
        node("Identity", &["b"], &["actions"]),
    ];
    let twice = vec![
        node("Identity", &["obs"], &["actions"]),
        node("Neg", &["obs"], &["actions"]),
    ];
    let scaled = vec![node("Mul", &["obs", "w"], &["actions"])];
    let mut huge = weight("w", &[1 << 31], &[1.0]);
    huge.data_location = 1;
    for (policy, said) in [
        (
            policy(cycle, vec![]),
            "value `b`: is read before it is computed",
        ),
        (policy(twice, vec![]), "value `actions`: is given twice"),
        (
            policy(vec![], vec![]),
            "output `actions`: is computed by no node",
        ),
        (
            policy(scaled.clone(), vec![weight("w", &[1], &[f32::NAN])]),
            "weight `w`: holds a value that is not a finite number",
        ),
        (
            policy(
                scaled.clone(),
                vec![weight("w", &[1], &[1.0]), weight("w", &[1], &[2.0])],
            ),
            "weight `w`: is there twice",
        ),
        (policy(scaled.clone(), vec![huge]), "weight `w`"),
        (policy(scaled, vec![weight("w", &[1 << 31], &[1.0])]), "w"),
        (
            policy(
                vec![
                    node("NonMaxSuppression", &["obs"], &["x"]),
                    node("Bogus", &["x"], &["actions"]),
                ],
                vec![],
            ),
            "operator Bogus",
        ),
    ] {
        let told = Case::new(&policy, &robot).refused();
        assert!(told.contains(said), "{said}: {told}");
    }
    let case = Case::new(&mirror(1), &robot);
    let whole = std::fs::read(case.path("policy.onnx")).expect("a file");
    for bytes in [
        &whole[..whole.len() / 2],
        b"",
        b"PK\x03\x04 no model",
        &whole[..3],
    ] {
        case.put("policy.onnx", bytes);
        assert!(case.refused().contains("policy.onnx"));
    }
    // A bundle needs no import.
    case.put("policy.onnx", &whole);
    let bundle = case.import().expect("it is imported").bundle;
    case.put("policy.onnx", &bundle);
    assert!(case.refused().contains("is a policy bundle already"));
}

#[test]
fn no_part_of_a_file_makes_it_panic() {
    let robot = format!("{HEAD}[[term]]\nname = \"a\"\n{SENSOR}{}", wide_action(2));
    let policy = model(
        vec![value("obs", &[-1, 2])],
        vec![
            node("MatMul", &["obs", "w"], &["x"]),
            node("Tanh", &["x"], &["actions"]),
        ],
        vec![weight("w", &[2, 2], &[0.1, 0.2, 0.3, 0.4])],
        vec![value("actions", &[-1, 2])],
    );
    let case = Case::new(&policy, &robot);
    case.import().unwrap_or_else(|error| panic!("{error}"));
    let whole = policy.encode_to_vec();
    for at in 0..whole.len() {
        for flip in [0x01, 0x80, 0xff] {
            let mut damaged = whole.clone();
            damaged[at] ^= flip;
            case.put("policy.onnx", &damaged);
            let _ = case.import();
        }
        case.put("policy.onnx", &whole[..at]);
        let _ = case.import();
    }
}

#[test]
fn an_operator_set_that_is_not_read_is_told_with_those_that_are() {
    let robot = format!(
        "{HEAD}[[term]]\nname = \"a\"\nwidth = 1\n{SENSOR}{}",
        wide_action(1)
    );
    for version in [6, 29] {
        let mut policy = mirror(1);
        policy.opset_import[0].version = version;
        let told = Case::new(&policy, &robot).refused();
        let wanted = format!("has ONNX operator set {version}, 7 to 28 are read");
        assert!(
            told.contains(&wanted) && told.contains("convert_version"),
            "{told}"
        );
        assert!(told.contains("1 thing to settle"), "{told}");
    }
}

/// Makes a weight of integers, as shapes and indices are.
fn integers(name: &str, dims: &[i64], values: &[i64]) -> lads_compiler::onnx::TensorProto {
    let raw: Vec<u8> = values.iter().flat_map(|x| x.to_le_bytes()).collect();
    lads_compiler::onnx::TensorProto {
        dims: dims.to_vec(),
        data_type: lads_compiler::onnx::data_type::INT64,
        name: name.into(),
        raw_data: raw.into(),
        ..Default::default()
    }
}

#[test]
fn parts_of_an_observation_that_the_policy_estimates_are_put_in_their_place() {
    // PyTorch's `obs[:, 1:3] = estimate`: the shape's axes behind the last one, which are none, are joined to that of the part.
    let robot = format!("{HEAD}[[term]]\nname = \"a\"\n{SENSOR}{}", wide_action(4));
    let policy = |last: NodeProto| {
        model(
            vec![value("obs", &[1, 4])],
            vec![
                node("Slice", &["obs", "zero", "two", "one"], &["part"]),
                node("Neg", &["part"], &["estimate"]),
                node("Shape", &["obs"], &["shape"]),
                node("Slice", &["shape", "two", "all", "zero"], &["rest"]),
                last,
                node("Reshape", &["estimate", "wanted"], &["updates"]),
                node("ScatterND", &["obs", "at", "updates"], &["actions"]),
            ],
            vec![
                integers("zero", &[1], &[0]),
                integers("one", &[1], &[1]),
                integers("two", &[1], &[2]),
                integers("all", &[1], &[i64::MAX]),
                integers("part_shape", &[2], &[1, 2]),
                integers("at", &[1, 2, 2], &[0, 1, 0, 2]),
            ],
            vec![value("actions", &[1, 4])],
        )
    };
    let mut joined = node("Concat", &["part_shape", "rest"], &["wanted"]);
    joined.attribute.push(AttributeProto {
        name: "axis".into(),
        kind: 2,
        ..Default::default()
    });
    let case = Case::new(&policy(joined), &robot);
    let actions = case.actions(&[step(&[&[1.0, 2.0, 3.0, 4.0]])]);
    common::close(&actions[0], &[1.0, -1.0, -2.0, 4.0]);
    // Anything else that reads no elements is refused.
    let read = node("Neg", &["rest"], &["wanted"]);
    let told = Case::new(&policy(read), &robot).refused();
    assert!(told.contains("node `wanted`"), "{told}");
}
