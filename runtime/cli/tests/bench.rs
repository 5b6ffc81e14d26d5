//! Tests of `lads bench`.

mod common;

use serde_json::Value;

use common::{answer, refused, tiny};

#[test]
fn bench_measures_every_kind_of_step() {
    let tiny = tiny();
    let tiny = tiny.to_str().unwrap();
    let short = [
        "bench",
        "--model",
        tiny,
        "--rate",
        "2000",
        "--seconds",
        "0.2",
    ];
    let text = answer(&short, "");
    for part in [
        "ordinary", "decision", "instruct", "act", "wake-up", "misses",
    ] {
        assert!(text.contains(part), "no '{part}' in:\n{text}");
    }
    let report: Value =
        serde_json::from_str(&answer(&[&short[..], &["--json"]].concat(), "")).unwrap();
    let contender = &report["contenders"][0];
    assert_eq!(contender["name"], "lads auto");
    assert_eq!(
        (&report["period_us"], &report["images"]),
        (&500.0.into(), &Value::Array(vec![]))
    );
    let latency = &contender["latency_us"];
    for kind in ["act", "ordinary", "decision", "instruct"] {
        let [p50, max] = ["p50", "max"].map(|q| latency[kind][q].as_f64().unwrap());
        assert!(p50 > 0.0 && p50 <= max, "{kind}: {latency}");
    }
    assert!(contender["largest_error"].as_f64().unwrap() < 1e-4);
    // 24 control steps in parts of two horizons of 4.
    let growth = contender["growth_us"].as_array().unwrap();
    assert!(!growth.is_empty() && growth[0][0] == 0, "{growth:?}");
}

#[test]
fn bench_refuses_what_makes_no_sense() {
    let tiny = tiny();
    let tiny = tiny.to_str().unwrap();
    for (arguments, parts) in [
        (&["--rate", "0"][..], &["--rate", "0.1 to 10000"][..]),
        (&["--rate", "nan"], &["--rate", "0.1 to 10000"]),
        (&["--seconds=-1"], &["--seconds", "0.1 to 86400"]),
        (&["--load", "100000"], &["--load", "at most"]),
    ] {
        refused(
            &[&["bench", "--model", tiny], arguments].concat(),
            "",
            parts,
        );
    }
    refused(&["bench", "--model", "no.onnx"], "", &["no.onnx"]);
}
