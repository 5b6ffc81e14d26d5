//! Small ONNX models, made in memory.

use bytes::Bytes;
use prost::Message;

use crate::entries::{Signature, Value};
use crate::graph::{Dim, Type};
use crate::onnx::{
    AttributeProto, DimensionProto, GraphProto, ModelProto, NodeProto, OperatorSetIdProto,
    TensorProto, TensorShapeProto, TensorTypeProto, TypeProto, ValueInfoProto, data_type,
};

/// Name of the entry of small models.
pub const ENTRY: &str = "test/graph";

/// A model of one entry under construction.
pub struct Small {
    pub graph: GraphProto,
    pub signature: Signature,
    random: u64,
}

pub fn int(name: &str, i: i64) -> AttributeProto {
    AttributeProto {
        name: name.into(),
        kind: 2,
        i,
        ..Default::default()
    }
}

pub fn ints(name: &str, ints: &[i64]) -> AttributeProto {
    AttributeProto {
        name: name.into(),
        kind: 7,
        ints: ints.to_vec(),
        ..Default::default()
    }
}

pub fn float(name: &str, f: f32) -> AttributeProto {
    AttributeProto {
        name: name.into(),
        kind: 1,
        f,
        ..Default::default()
    }
}

pub fn text(name: &str, s: &str) -> AttributeProto {
    AttributeProto {
        name: name.into(),
        kind: 3,
        s: Bytes::copy_from_slice(s.as_bytes()),
        ..Default::default()
    }
}

fn full(name: &str) -> String {
    format!("{ENTRY}/{name}")
}

impl Small {
    pub fn new() -> Self {
        Self {
            graph: GraphProto::default(),
            signature: Signature {
                entry: ENTRY.into(),
                inputs: vec![],
                outputs: vec![],
            },
            random: 1,
        }
    }

    /// Returns numbers between -1 and 1, always the same ones (xorshift, Marsaglia 2003).
    pub fn numbers(&mut self, len: usize) -> Vec<f32> {
        let mut next = || {
            self.random ^= self.random << 13;
            self.random ^= self.random >> 7;
            self.random ^= self.random << 17;
            (self.random >> 40) as f32 / (1u64 << 23) as f32 - 1.0
        };
        next();
        (0..len).map(|_| next()).collect()
    }

    fn value(name: &str, elem_type: i32, shape: &[Dim]) -> ValueInfoProto {
        let dim = shape
            .iter()
            .map(|dim| match dim.known() {
                Some(len) => DimensionProto {
                    dim_value: Some(len as i64),
                    dim_param: None,
                },
                None => DimensionProto {
                    dim_value: None,
                    dim_param: Some(dim.to_string()),
                },
            })
            .collect();
        let tensor = TensorTypeProto {
            elem_type,
            shape: Some(TensorShapeProto { dim }),
        };
        ValueInfoProto {
            name: full(name),
            r#type: Some(TypeProto {
                tensor_type: Some(tensor),
            }),
        }
    }

    fn edge(name: &str, ty: Type, shape: &[Dim]) -> (ValueInfoProto, Value) {
        let code = if ty == Type::F32 {
            data_type::FLOAT
        } else {
            data_type::INT64
        };
        (
            Self::value(name, code, shape),
            Value {
                name: name.into(),
                ty,
                shape: shape.to_vec(),
                fields: "test".into(),
            },
        )
    }

    pub fn input_dims(mut self, name: &str, ty: Type, shape: &[Dim]) -> Self {
        let (info, value) = Self::edge(name, ty, shape);
        self.graph.input.push(info);
        self.signature.inputs.push(value);
        self
    }

    pub fn output_dims(mut self, name: &str, ty: Type, shape: &[Dim]) -> Self {
        let (info, value) = Self::edge(name, ty, shape);
        self.graph.output.push(info);
        self.signature.outputs.push(value);
        self
    }

    pub fn input(self, name: &str, shape: &[usize]) -> Self {
        let dims: Vec<Dim> = shape.iter().map(|&dim| Dim::of(dim)).collect();
        self.input_dims(name, Type::F32, &dims)
    }

    pub fn output(self, name: &str, shape: &[usize]) -> Self {
        let dims: Vec<Dim> = shape.iter().map(|&dim| Dim::of(dim)).collect();
        self.output_dims(name, Type::F32, &dims)
    }

    /// Adds a constant with these values.
    pub fn weights(mut self, name: &str, shape: &[usize], values: &[f32]) -> Self {
        let tensor = TensorProto {
            name: full(name),
            dims: shape.iter().map(|&dim| dim as i64).collect(),
            data_type: data_type::FLOAT,
            raw_data: values
                .iter()
                .flat_map(|x| x.to_le_bytes())
                .collect::<Vec<u8>>()
                .into(),
            ..Default::default()
        };
        self.graph.initializer.push(tensor);
        self
    }

    /// Adds a constant of random numbers.
    pub fn random(mut self, name: &str, shape: &[usize]) -> Self {
        let values = self.numbers(shape.iter().product());
        self.weights(name, shape, &values)
    }

    /// Adds a constant of integers along one axis.
    pub fn integers(mut self, name: &str, values: &[i64]) -> Self {
        let tensor = TensorProto {
            name: full(name),
            dims: vec![values.len() as i64],
            data_type: data_type::INT64,
            int64_data: values.to_vec(),
            ..Default::default()
        };
        self.graph.initializer.push(tensor);
        self
    }

    /// Adds a node; an empty name leaves an input or output out.
    pub fn node(
        mut self,
        op_type: &str,
        inputs: &[&str],
        outputs: &[&str],
        attribute: &[AttributeProto],
    ) -> Self {
        let names = |names: &[&str]| {
            names
                .iter()
                .map(|name| {
                    if name.is_empty() {
                        String::new()
                    } else {
                        full(name)
                    }
                })
                .collect()
        };
        let node = NodeProto {
            op_type: op_type.into(),
            name: format!("{op_type}_{}", self.graph.node.len()),
            input: names(inputs),
            output: names(outputs),
            attribute: attribute.to_vec(),
            ..Default::default()
        };
        self.graph.node.push(node);
        self
    }

    pub fn model(&self, opset: i64) -> ModelProto {
        ModelProto {
            ir_version: 8,
            opset_import: vec![OperatorSetIdProto {
                domain: String::new(),
                version: opset,
            }],
            graph: Some(GraphProto {
                name: "test".into(),
                ..self.graph.clone()
            }),
            ..Default::default()
        }
    }

    pub fn bytes(&self, opset: i64) -> Vec<u8> {
        self.model(opset).encode_to_vec()
    }
}
