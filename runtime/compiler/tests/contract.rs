//! Tests that contracts that miss something, or contradict themselves, are refused by the field.

mod tiny;

use lads_compiler::Contract;
use serde_json::Value;

/// A broken contract: the place of the change, the JSON written there (nothing: it is removed), and
/// the expected parts of the error.
type Broken = (&'static str, &'static str, &'static [&'static str]);

const BROKEN: &[Broken] = &[
    ("/family/kind", r#""lasd""#, &["lasd"]),
    ("/family/horizon", "", &["`family.horizon` is missing"]),
    ("/family/horizon", "0", &["`family.horizon` is 0"]),
    ("/family/codebook/dim", "0", &["`family.codebook.dim` is 0"]),
    (
        "/family/decision/temperature",
        "0.0",
        &["`family.decision.temperature` is 0"],
    ),
    ("/family/decision/rule", r#""guess""#, &["guess"]),
    ("/environment", "", &["`environment`"]),
    ("/control_period_s", "0.0", &["`control_period_s` is 0"]),
    ("/channels", "[]", &["`channels`", "0 observations"]),
    ("/channels/4", "", &["`channels`", "0 actions"]),
    (
        "/channels/1",
        "",
        &["`channels` has no instruction", "lads"],
    ),
    (
        "/channels/1/name",
        r#""action""#,
        &["channels[4].name", "repeats \"action\""],
    ),
    ("/channels/0/role", r#""sensor""#, &["sensor"]),
    ("/channels/0/dtype", r#""f64""#, &["f64"]),
    (
        "/channels/0/shape",
        "[6]",
        &["`channels[0].elements` has 5 elements"],
    ),
    ("/channels/0/shape", "[]", &["`channels[0].shape` is []"]),
    (
        "/channels/0/elements/2/min",
        "1.0",
        &["`channels[0].elements[2]` (drawer)", "no range"],
    ),
    (
        "/channels/4/dtype",
        r#""u8""#,
        &["`channels[4].elements`", "only vectors of f32"],
    ),
    (
        "/channels/4/elements/0/scale",
        "1e39",
        &["channels[4].elements[0]"],
    ),
    ("/context", "null", &["`context`"]),
    ("/context/steps", "0", &["`context.steps` is 0"]),
    (
        "/context/steps",
        "22",
        &["`context.steps` is 22", "multiple", "4"],
    ),
    ("/context/words", "7", &["`context.words` is not"]),
    ("/context/beyond", r#""stop""#, &["stop"]),
    ("/instructions", "[]", &["`instructions` has 0"]),
    (
        "/instructions/1/id",
        r#""dl""#,
        &["instructions[1].id", "repeats \"dl\""],
    ),
    (
        "/instructions/1/text",
        r#"" ""#,
        &["`instructions[1].text` is empty"],
    ),
    ("/language", "null", &["`language`"]),
    ("/language/dim", "9", &["`language.dim` is 9"]),
    ("/network", "null", &["`network`"]),
    ("/network/heads", "0", &["`network.heads` is 0"]),
    (
        "/evaluation/instructions/3",
        "",
        &["`evaluation.instructions` has 3"],
    ),
    (
        "/evaluation/instructions/0/split",
        r#""""#,
        &["`evaluation.instructions[0].split` is empty"],
    ),
    (
        "/states",
        r#"[{"name": "h", "kind": "plain", "shape": [0]}]"#,
        &["`states[0].shape` is [0]"],
    ),
    (
        "/states",
        r#"[{"name": "r", "kind": "ring", "rows": 0}]"#,
        &["`states[0].rows` is 0"],
    ),
    (
        "/states",
        r#"[{"name": "r", "kind": "ring", "rows": 2, "source": "action"}]"#,
        &["`states[0].source` is \"action\""],
    ),
    ("/provenance", "", &["`provenance`"]),
];

/// Writes a value, or removes the existing one.
fn change(contract: &mut Value, pointer: &str, value: &str) {
    let (parent, last) = pointer.rsplit_once('/').expect("a pointer");
    let parent = contract.pointer_mut(parent).expect("it is there");
    match (parent, serde_json::from_str::<Value>(value)) {
        (Value::Object(fields), Ok(value)) => drop(fields.insert(last.into(), value)),
        (Value::Object(fields), Err(_)) => drop(fields.remove(last)),
        (Value::Array(rows), Err(_)) => drop(rows.remove(last.parse().expect("an index"))),
        (parent, value) => panic!("{pointer}: {value:?} in {parent}"),
    }
}

#[test]
fn every_field_is_refused_by_its_name() {
    Contract::parse(&tiny::contract().0.to_string()).expect("the contract itself is sound");
    for (pointer, value, parts) in BROKEN {
        let (mut contract, _) = tiny::contract();
        change(&mut contract, pointer, value);
        let Err(error) = Contract::parse(&contract.to_string()) else {
            panic!("{pointer} = {value} is read")
        };
        let message = error.to_string();
        for part in *parts {
            let said = message.contains(part);
            assert!(
                said,
                "{pointer} = {value}: \"{message}\" does not say {part:?}"
            );
        }
        assert!(!message.contains('\n'), "{message}");
    }
}
