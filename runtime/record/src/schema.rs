//! Channels of a log and their JSON schemas.

use serde_json::{Value, json};

/// Name of the schema of cameras' messages, by which Foxglove knows them.
pub const IMAGE: &str = "foxglove.CompressedImage";

/// JSON schema of cameras' messages, the fields of Foxglove's.
pub fn image_schema() -> String {
    json!({
        "title": IMAGE,
        "description": "What a camera showed the policy.",
        "type": "object",
        "properties": {
            "timestamp": {
                "type": "object",
                "title": "time",
                "properties": {
                    "sec": {"type": "integer", "minimum": 0},
                    "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
                },
                "description": "simulated time",
            },
            "frame_id": {"type": "string", "description": "name of the contract's channel"},
            "data": {"type": "string", "contentEncoding": "base64", "description": "the file"},
            "format": {"type": "string", "description": "png"},
        },
    })
    .to_string()
}

/// A topic with the name and the JSON schema of its messages.
pub struct Topic {
    /// Name of the topic.
    pub name: &'static str,
    /// Name of the schema.
    pub schema: &'static str,
    /// Description of the messages, for people.
    about: &'static str,
    /// Name, JSON type and meaning of each field.
    fields: &'static [(&'static str, Kind, &'static str)],
}

enum Kind {
    Number,
    Integer,
    Flag,
    Text,
    Numbers,
    MaybeInteger,
    MaybeNumber,
    MaybeText,
}

impl Kind {
    fn schema(&self) -> Value {
        match self {
            Self::Number => json!({"type": "number"}),
            Self::Integer => json!({"type": "integer"}),
            Self::Flag => json!({"type": "boolean"}),
            Self::Text => json!({"type": "string"}),
            Self::Numbers => json!({"type": "array", "items": {"type": "number"}}),
            Self::MaybeInteger => json!({"type": ["integer", "null"]}),
            Self::MaybeNumber => json!({"type": ["number", "null"]}),
            Self::MaybeText => json!({"type": ["string", "null"]}),
        }
    }
}

impl Topic {
    /// Returns the JSON schema as text.
    pub fn json_schema(&self) -> String {
        let properties: serde_json::Map<String, Value> = self
            .fields
            .iter()
            .map(|(name, kind, about)| {
                let mut schema = kind.schema();
                schema["description"] = json!(about);
                ((*name).to_owned(), schema)
            })
            .collect();
        json!({
            "title": self.schema,
            "description": self.about,
            "type": "object",
            "properties": properties,
        })
        .to_string()
    }
}

pub const EPISODE: usize = 0;
pub const OBSERVATION: usize = 1;
pub const ACTION: usize = 2;
pub const PLAN: usize = 3;
pub const LOGITS: usize = 4;
pub const TIMING: usize = 5;
pub const GRIPPER: usize = 6;
pub const COMPLETION: usize = 7;

/// Topics of a recording; constants such as [`EPISODE`] are their indices.
pub const TOPICS: [Topic; 8] = [
    Topic {
        name: "/episode",
        schema: "lads.Episode",
        about: "An episode begins.",
        fields: &[
            ("instruction", Kind::Integer, "index in the policy's table"),
            ("instruction_id", Kind::Text, "short name"),
            ("instruction_text", Kind::Text, "what the policy is told"),
            (
                "words",
                Kind::Numbers,
                "word embeddings by the language encoder; absent where the bundle's own were heard",
            ),
            ("episode", Kind::Integer, "number within the instruction"),
            (
                "sampling_seed",
                Kind::MaybeText,
                "seed of plan sampling, null for argmax",
            ),
            (
                "noise_seed",
                Kind::Text,
                "seed of what else the policy draws at random; absent where it draws nothing",
            ),
            ("commanded", Kind::Flag, "plans were given"),
            (
                "continued",
                Kind::Flag,
                "random draws go on from the episode before; absent where they begin anew",
            ),
            (
                "steps",
                Kind::Integer,
                "control steps that follow; absent where it was recorded while it ran",
            ),
            (
                "success",
                Kind::Flag,
                "the instruction was carried out; absent where nobody knew yet",
            ),
        ],
    },
    Topic {
        name: "/observation",
        schema: "lads.Observation",
        about: "What the policy saw.",
        fields: &[(
            "values",
            Kind::Numbers,
            "elements in the contract's order and units",
        )],
    },
    Topic {
        name: "/action",
        schema: "lads.Action",
        about: "What the policy answered and what was executed.",
        fields: &[
            ("policy", Kind::Numbers, "the controller's action"),
            ("executed", Kind::Numbers, "what the actuators were given"),
        ],
    },
    Topic {
        name: "/plan",
        schema: "lads.Plan",
        about: "The plan in force.",
        fields: &[
            (
                "index",
                Kind::MaybeInteger,
                "its index; null of a policy that selects none",
            ),
            ("decided", Kind::Flag, "decided in this control step"),
            (
                "margin",
                Kind::MaybeNumber,
                "largest score minus the second largest",
            ),
        ],
    },
    Topic {
        name: "/logits",
        schema: "lads.Logits",
        about: "The scores of a decision.",
        fields: &[("values", Kind::Numbers, "one per plan")],
    },
    Topic {
        name: "/timing",
        schema: "lads.Timing",
        about: "How long the control step took.",
        fields: &[("controller_ns", Kind::Integer, "inside the controller, ns")],
    },
    Topic {
        name: "/gripper",
        schema: "lads.Gripper",
        about: "Where the gripper was when the observation was taken, m.",
        fields: &[
            ("x", Kind::Number, "world frame"),
            ("y", Kind::Number, "world frame"),
            ("z", Kind::Number, "world frame"),
        ],
    },
    Topic {
        name: "/completion",
        schema: "lads.Completion",
        about: "A sub-task was completed.",
        fields: &[
            ("sub_task", Kind::Text, "its name"),
            (
                "step",
                Kind::Integer,
                "control step, from 1, after which it held",
            ),
        ],
    },
];
