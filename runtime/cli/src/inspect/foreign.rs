//! Report on an ONNX file that is not a policy, or a bundle with faults: its content, and everything that it lacks.

use std::fmt::{self, Display, Formatter};
use std::path::Path;

use lads_compiler::{Field, Missing, Operand, Operator, Survey, Value as Edge};
use serde_json::{Value, json};

use crate::refusal::Refusal;

/// Content and gaps of a file that is not a policy.
pub struct Foreign<'p> {
    path: &'p Path,
    survey: Survey,
}

impl<'p> Foreign<'p> {
    /// Surveys a file that was refused, if it is an ONNX model.
    pub fn look(path: &'p Path, refusal: &Refusal) -> Option<Self> {
        let bytes = lads_host::input::read(path).ok()?;
        let mut survey = lads_compiler::survey(&bytes).ok()?;
        if survey.missing.is_empty() {
            // What only a compilation finds, such as too large a workspace.
            survey.missing.contract.push(Field {
                field: "policy".into(),
                needed: refusal.to_string(),
            });
        }
        Some(Self { path, survey })
    }

    fn is_bundle(&self) -> bool {
        let mut keys = self.survey.metadata.iter();
        keys.any(|key| key == "lads.contract")
    }

    /// Formats everything as one JSON object.
    pub fn json(&self) -> Value {
        let Survey {
            opset,
            producer,
            nodes,
            inputs,
            outputs,
            metadata,
            missing,
        } = &self.survey;
        let edge = |value: &Edge| json!({ "name": value.name, "dtype": value.dtype, "shape": value.shape });
        json!({
            "file": self.path.display().to_string(),
            "form": "onnx",
            "opset": opset,
            "producer": producer,
            "nodes": nodes,
            "inputs": inputs.iter().map(edge).collect::<Vec<_>>(),
            "outputs": outputs.iter().map(edge).collect::<Vec<_>>(),
            "metadata": metadata,
            "missing": missing_json(missing),
        })
    }
}

fn missing_json(missing: &Missing) -> Value {
    let operand = |operand: &Operand| json!({ "name": operand.name, "shape": operand.shape });
    let operators = missing.operators.iter().map(|node| {
        json!({
            "operator": node.operator,
            "node": node.node,
            "inputs": node.inputs.iter().map(operand).collect::<Vec<_>>(),
            "problem": node.problem,
        })
    });
    let fields = (missing.contract.iter())
        .map(|field| json!({ "field": field.field, "needed": field.needed }));
    json!({
        "operators": operators.collect::<Vec<_>>(),
        "contract": fields.collect::<Vec<_>>(),
    })
}

impl Display for Foreign<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let survey = &self.survey;
        let opset = survey.opset.map(|set| format!(", operator set {set}"));
        let (what, of_operators, of_contract) = if self.is_bundle() {
            (
                "a bundle that is no sound policy",
                "operators that do not compile",
                "faults of its contract, graphs and episode",
            )
        } else {
            (
                "an ONNX model that is not a policy yet",
                "operators that are missing",
                "what a contract has to say and nothing here does",
            )
        };
        writeln!(
            f,
            "{}: {what}{}, {} nodes",
            self.path.display(),
            opset.unwrap_or_default(),
            survey.nodes
        )?;
        for (what, values) in [("input", &survey.inputs), ("output", &survey.outputs)] {
            for Edge { name, dtype, shape } in values {
                writeln!(f, "  {what:<6} {name}: {dtype} [{}]", shape.join(", "))?;
            }
        }
        let Missing {
            operators,
            contract,
        } = &survey.missing;
        writeln!(f, "\n{of_operators} ({})", operators.len())?;
        for Operator {
            operator,
            node,
            inputs,
            problem,
        } in operators
        {
            let read = inputs.iter();
            let read: Vec<_> = read
                .map(|Operand { name, shape }| format!("{name} {shape}"))
                .collect();
            writeln!(f, "  {operator} `{node}` of {}: {problem}", read.join(", "))?;
        }
        writeln!(f, "\n{of_contract} ({})", contract.len())?;
        for field in contract {
            writeln!(f, "  {}: {}", field.field, field.needed)?;
        }
        if self.is_bundle() {
            return writeln!(f, "\nMend what made the bundle, and export it again.");
        }
        writeln!(
            f,
            "\n`lads import {} --template` prints the form in which a person says it",
            self.path.display()
        )
    }
}
