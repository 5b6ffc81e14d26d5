//! Small policies whose action mirrors their input, so that the nodes that an import puts before
//! them can be tested.
#![allow(dead_code, reason = "each suite uses its part")]

use std::path::PathBuf;

use lads_compiler::onnx::{
    DimensionProto, GraphProto, ModelProto, NodeProto, OperatorSetIdProto, StringStringEntryProto,
    TensorProto, TensorShapeProto, TensorTypeProto, TypeProto, ValueInfoProto, data_type,
};
use lads_core::{ChannelId, Data};
use lads_import::{ImportError, Imported, Request, import};
use prost::Message as _;
use tempfile::TempDir;

/// Makes an input or output of a graph; a length below zero is an axis called `batch`.
pub fn value(name: &str, dims: &[i64]) -> ValueInfoProto {
    let dim = |&dim: &i64| DimensionProto {
        dim_value: (dim >= 0).then_some(dim),
        dim_param: (dim < 0).then(|| "batch".into()),
    };
    ValueInfoProto {
        name: name.into(),
        r#type: Some(TypeProto {
            tensor_type: Some(TensorTypeProto {
                elem_type: data_type::FLOAT,
                shape: Some(TensorShapeProto {
                    dim: dims.iter().map(dim).collect(),
                }),
            }),
        }),
    }
}

pub fn node(operator: &str, inputs: &[&str], outputs: &[&str]) -> NodeProto {
    NodeProto {
        input: inputs.iter().map(|&name| name.into()).collect(),
        output: outputs.iter().map(|&name| name.into()).collect(),
        name: outputs.first().map_or(String::new(), |&name| name.into()),
        op_type: operator.into(),
        ..NodeProto::default()
    }
}

pub fn weight(name: &str, dims: &[i64], values: &[f32]) -> TensorProto {
    TensorProto {
        dims: dims.to_vec(),
        data_type: data_type::FLOAT,
        name: name.into(),
        raw_data: values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect::<Vec<u8>>()
            .into(),
        ..TensorProto::default()
    }
}

pub fn model(
    inputs: Vec<ValueInfoProto>,
    nodes: Vec<NodeProto>,
    weights: Vec<TensorProto>,
    outputs: Vec<ValueInfoProto>,
) -> ModelProto {
    ModelProto {
        ir_version: 8,
        opset_import: vec![OperatorSetIdProto {
            domain: String::new(),
            version: 17,
        }],
        producer_name: "test".into(),
        graph: Some(GraphProto {
            node: nodes,
            name: "policy".into(),
            initializer: weights,
            input: inputs,
            output: outputs,
            ..GraphProto::default()
        }),
        metadata_props: vec![],
    }
}

/// Makes a policy whose action is its observation.
pub fn mirror(width: i64) -> ModelProto {
    model(
        vec![value("obs", &[1, width])],
        vec![node("Identity", &["obs"], &["actions"])],
        vec![],
        vec![value("actions", &[1, width])],
    )
}

pub fn says(model: &mut ModelProto, pairs: &[(&str, &str)]) {
    for (key, value) in pairs {
        model.metadata_props.push(StringStringEntryProto {
            key: (*key).into(),
            value: (*value).into(),
        });
    }
}

/// Returns the part of a description that all tests of a mirror's action share.
pub fn wide_action(width: usize) -> String {
    let names: Vec<String> = (0..width).map(|i| format!("\"a{i}\"")).collect();
    format!(
        "[action]\nelements = [{}]\nunit = \"1\"\nscale = 1\noffset = 0\nmin = -1000\nmax = 1000\n",
        names.join(", ")
    )
}

/// Fields of a description that every policy needs.
pub const HEAD: &str =
    "environment = { id = \"test\", version = \"1\" }\ncontrol_period_s = 0.02\n";

/// Fields of a term with a unit and limits.
pub const SENSOR: &str = "unit = \"1\"\nmin = -100\nmax = 100\n";

/// A folder with a policy and a description.
pub struct Case {
    pub folder: TempDir,
    model: PathBuf,
    robot: PathBuf,
}

impl Case {
    pub fn new(model: &ModelProto, robot: &str) -> Self {
        let folder = TempDir::new().expect("a folder");
        let case = Self {
            model: folder.path().join("policy.onnx"),
            robot: folder.path().join("robot.toml"),
            folder,
        };
        case.put("policy.onnx", &model.encode_to_vec());
        case.put("robot.toml", robot.as_bytes());
        case
    }

    pub fn put(&self, name: &str, bytes: &[u8]) {
        let path = self.path(name);
        std::fs::create_dir_all(path.parent().expect("a parent")).expect("a folder");
        std::fs::write(path, bytes).expect("it is written");
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub fn import(&self) -> Result<Imported, ImportError> {
        self.import_with(|_| {})
    }

    pub fn import_with<'r>(
        &'r self,
        change: impl FnOnce(&mut Request<'r>),
    ) -> Result<Imported, ImportError> {
        let mut request = Request {
            models: vec![self.model.as_path()],
            robot: Some(&self.robot),
            ..Request::default()
        };
        change(&mut request);
        import(&request)
    }

    /// Returns the problems of a refused import, as one text.
    pub fn refused(&self) -> String {
        match self.import() {
            Ok(_) => panic!("it was imported"),
            Err(error) => error.to_string(),
        }
    }

    /// Returns the actions of all steps.
    pub fn actions(&self, steps: &[Happens]) -> Vec<Vec<f32>> {
        let imported = self.import().unwrap_or_else(|error| panic!("{error}"));
        run(&imported.bundle, steps)
    }
}

/// Event of a control period.
pub enum Happens {
    /// A step with the values of all channels.
    Step(Vec<Vec<f32>>),
    /// The start of another episode.
    Reset,
}

pub fn step(rows: &[&[f32]]) -> Happens {
    Happens::Step(rows.iter().map(|row| row.to_vec()).collect())
}

pub fn run(bundle: &[u8], steps: &[Happens]) -> Vec<Vec<f32>> {
    let opened = lads_host::from_bytes(bundle).unwrap_or_else(|error| panic!("{error}"));
    let mut loaded = opened.load().expect("memory");
    let mut controller = loaded.controller();
    controller.self_test().expect("the golden steps replay");
    let contract = controller.policy().contract();
    let ids: Vec<ChannelId> = contract
        .observations()
        .map(|channel| channel.id())
        .collect();
    let mut action = vec![0.0; contract.action_len()];
    let mut all = vec![];
    for step in steps {
        let Happens::Step(rows) = step else {
            controller.reset();
            continue;
        };
        let given: Vec<(ChannelId, Data)> = (ids.iter().copied())
            .zip(rows.iter().map(|row| Data::F32(row)))
            .collect();
        controller.step_with(&given, &mut action).expect("a step");
        all.push(action.clone());
    }
    all
}

/// Asserts that two actions are equal up to rounding.
#[track_caller]
pub fn close(got: &[f32], wanted: &[f32]) {
    assert_eq!(got.len(), wanted.len());
    for (got_one, wanted_one) in got.iter().zip(wanted) {
        assert!(
            (got_one - wanted_one).abs() < 1e-5,
            "{got:?} is not {wanted:?}"
        );
    }
}
