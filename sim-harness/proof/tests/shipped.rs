//! Tests the shipped references: they can be read, are what their own contracts say, come from the training and record all that is
//! compared.

use std::path::Path;

use lads_proof::reference::{Reference, Subject};

#[test]
fn shipped_references_are_whole() {
    for (name, environment, state_len) in [
        ("kitchen", "franka-kitchen", 30),
        ("kitchen-small", "franka-kitchen", 30),
        ("lorel", "lorel-table", 15),
        ("lorel-image", "lorel-table", 15),
        ("kitchen-image", "franka-kitchen", 30),
    ] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../models")
            .join(format!("{name}.reference.json"));
        let reference = Reference::open(&path).unwrap();
        let contract = reference.contract.as_ref().unwrap();
        let channels = contract["channels"].as_array().unwrap();
        // A camera's frame has three dimensions.
        let shapes = |role: &'static str, dimensions: usize| {
            let own = channels.iter().filter(move |row| row["role"] == role);
            let shapes = own.map(|row| row["shape"].as_array().unwrap());
            shapes.filter(move |shape| shape.len() == dimensions)
        };
        let len = |role| {
            shapes(role, 1)
                .next()
                .map_or(0, |shape| shape[0].as_u64().unwrap() as usize)
        };
        let subject = Subject {
            contract: "",
            instructions: reference
                .instructions
                .iter()
                .map(|row| row.text.as_str())
                .collect(),
            environment_id: environment,
            environment_version: "1",
            state_len,
            observation_len: len("observation"),
            sees: shapes("observation", 3).next().is_some(),
            draws: false,
            action_len: len("action"),
        };
        reference.check(&subject).unwrap();
        assert_eq!(reference.weights_from, "the run's checkpoint", "{name}");
        assert!(reference.float_noise.is_some());
        let episodes = reference.instructions.iter().flat_map(|row| &row.episodes);
        let mut traces = episodes.filter_map(|episode| Some((episode, episode.trace.as_ref()?)));
        assert!(traces.all(|(episode, trace)| {
            // A policy that sees has no trajectory encoder in its bundle.
            let segments = (!subject.sees).then_some(episode.steps / reference.period.unwrap());
            !trace.logits.is_empty() && trace.encoded.as_ref().map(Vec::len) == segments
        }));
    }
}

#[test]
fn shipped_certificates_are_of_equivalent_policies() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/certificates");
    let page = std::fs::read_to_string(folder.join("README.md")).unwrap();
    let mut count = 0;
    for entry in std::fs::read_dir(&folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|extension| extension != "json") {
            continue;
        }
        let text = std::fs::read_to_string(&path).unwrap();
        let certificate: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert_eq!(certificate["format"], "lads-certificate");
        assert_eq!(certificate["verdict"], "EQUIVALENT", "{}", path.display());
        let name = path.file_name().unwrap().to_str().unwrap();
        assert!(page.contains(name), "{name} is not in README.md");
        count += 1;
    }
    assert!(count > 0);
}
