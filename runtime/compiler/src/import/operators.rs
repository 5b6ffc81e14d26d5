//! Translates ONNX operators that compute: the table of operators. Operators on images are in
//! [`images`](super::images), operators that move elements in [`shapes`](super::shapes).

use lads_image::op::{BinaryKind, ReduceKind, UnaryKind};

use super::activations::{
    celu, elu, gelu, hard_sigmoid, hard_swish, prelu, selu, softsign, swish, thresholded_relu,
};
use super::arithmetic::{clip, fold, multiply, power};
use super::attributes::Attributes;
use super::einsum::einsum;
use super::layers::{gemm, log_softmax, matmul, softmax};
use super::logic::{Comparison, both, compare, either, not, select};
use super::norms::{batch_norm, group_norm, instance_norm, layer_norm, rms_norm};
use super::reductions::{arg, reduce};
use super::{Operands, arithmetic, images, recurrent};
use crate::graph::{Graph, Id, Op, Unary};

/// Values that a node outputs.
pub(super) type Outputs = Result<Vec<Id>, String>;

/// Adds a node's operations to the graph.
pub(super) fn translate(g: &mut Graph, operator: &str, x: &Operands, a: &Attributes) -> Outputs {
    let unary = |g: &mut Graph, kind| arithmetic::unary(g, kind, x.get(0)?).map(|y| vec![y]);
    match operator {
        "Add" => fold(g, x, BinaryKind::Add, 2),
        "Sub" => fold(g, x, BinaryKind::Sub, 2),
        "Mul" => multiply(g, x.get(0)?, x.get(1)?).map(|y| vec![y]),
        "Div" => fold(g, x, BinaryKind::Div, 2),
        "Pow" => power(g, x),
        "Max" => fold(g, x, BinaryKind::Max, usize::MAX),
        "Min" => fold(g, x, BinaryKind::Min, usize::MAX),
        "Sum" => fold(g, x, BinaryKind::Add, usize::MAX),
        "Relu" => unary(g, UnaryKind::Relu),
        "Tanh" => unary(g, UnaryKind::Tanh),
        "Sigmoid" => unary(g, UnaryKind::Sigmoid),
        "Exp" => unary(g, UnaryKind::Exp),
        "Log" => unary(g, UnaryKind::Log),
        "Sqrt" => unary(g, UnaryKind::Sqrt),
        "Neg" => unary(g, UnaryKind::Neg),
        "Abs" => unary(g, UnaryKind::Abs),
        "Reciprocal" => unary(g, UnaryKind::Recip),
        "Erf" => unary(g, UnaryKind::Erf),
        "LeakyRelu" => {
            let unary = Unary::with(UnaryKind::LeakyRelu, a.float("alpha", 0.01)?);
            g.unary(unary, x.get(0)?).map(|y| vec![y])
        }
        "Gelu" => gelu(g, x, a),
        "Elu" => elu(g, x, a),
        "Selu" => selu(g, x, a),
        "Celu" => celu(g, x, a),
        "ThresholdedRelu" => thresholded_relu(g, x, a),
        "PRelu" => prelu(g, x),
        "Softplus" => unary(g, UnaryKind::Softplus),
        "Mish" => unary(g, UnaryKind::Mish),
        "HardSigmoid" => hard_sigmoid(g, x, a),
        "HardSwish" => hard_swish(g, x),
        "Softsign" => softsign(g, x),
        "Swish" => swish(g, x, a),
        "Clip" => clip(g, x, a),
        "Equal" => compare(g, x, Comparison::Equal),
        "Greater" => compare(g, x, Comparison::Greater),
        "GreaterOrEqual" => compare(g, x, Comparison::GreaterOrEqual),
        "Less" => compare(g, x, Comparison::Less),
        "LessOrEqual" => compare(g, x, Comparison::LessOrEqual),
        "Not" => not(g, x),
        "And" => both(g, x, BinaryKind::Mul),
        "Or" => both(g, x, BinaryKind::Max),
        "Xor" => either(g, x),
        "Where" => select(g, x),
        "MatMul" => matmul(g, x),
        "Einsum" => einsum(g, x, a),
        "Gemm" => gemm(g, x, a),
        "Softmax" => softmax(g, x, a),
        "LogSoftmax" => log_softmax(g, x, a),
        "LayerNormalization" => layer_norm(g, x, a),
        "RMSNormalization" => rms_norm(g, x, a),
        "GroupNormalization" => group_norm(g, x, a),
        "InstanceNormalization" => instance_norm(g, x, a),
        "BatchNormalization" => batch_norm(g, x, a),
        "ReduceSum" => reduce(g, x, a, ReduceKind::Sum, None),
        "ReduceMean" => reduce(g, x, a, ReduceKind::Mean, None),
        "ReduceMax" => reduce(g, x, a, ReduceKind::Max, None),
        "ReduceMin" => reduce(g, x, a, ReduceKind::Min, None),
        "ReduceProd" => reduce(g, x, a, ReduceKind::Prod, None),
        "ReduceSumSquare" => reduce(g, x, a, ReduceKind::Sum, Some(UnaryKind::Square)),
        "ReduceL1" => reduce(g, x, a, ReduceKind::Sum, Some(UnaryKind::Abs)),
        "ReduceL2" => {
            let sum = reduce(g, x, a, ReduceKind::Sum, Some(UnaryKind::Square))?;
            g.unary(Unary::of(UnaryKind::Sqrt), sum[0]).map(|y| vec![y])
        }
        "ArgMin" => arg(g, x, a, Op::ArgMin),
        "ArgMax" => arg(g, x, a, Op::ArgMax),
        "LSTM" => recurrent::lstm(g, x, a),
        "GRU" => recurrent::gru(g, x, a),
        _ => images::translate(g, operator, x, a),
    }
}
