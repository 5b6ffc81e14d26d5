//! Imports LSTM and GRU, unrolled: the number of steps is static, so every step becomes operations
//! of its own.
//!
//! LSTM, with the gates in ONNX' order i, o, f, c (Hochreiter & Schmidhuber 1997, with forget gates):
//! `g = x_t·W^T + h·R^T + Wb + Rb`, `c = sigmoid(g_f) * c + sigmoid(g_i) * tanh(g_c)`, `h = sigmoid(g_o) * tanh(c)`.
//!
//! GRU, with the gates in the order z, r, h (Cho et al. 2014): `z = sigmoid(..)`, `r = sigmoid(..)`,
//! `n = tanh(x_t·W_h^T + Wb_h + (r * h)·R_h^T + Rb_h)`, or with `linear_before_reset`, as `PyTorch` has it,
//! `n = tanh(x_t·W_h^T + Wb_h + r * (h·R_h^T + Rb_h))`; then `h = (1 - z) * n + z * h`.
//!
//! The input's share of all steps is one product.

use lads_image::op::{BinaryKind, UnaryKind};

use super::Operands;
use super::attributes::Attributes;
use super::operators::Outputs;
use crate::graph::{Dim, Graph, Id, Unary};

/// Largest number of steps that are unrolled.
const MAX_STEPS: usize = 512;

/// Kind of recurrent network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Lstm,
    Gru {
        /// True if the hidden state is multiplied by its weights before the reset gate is applied.
        linear_before_reset: bool,
    },
}

impl Kind {
    fn gates(self) -> usize {
        match self {
            Self::Lstm => 4,
            Self::Gru { .. } => 3,
        }
    }

    /// Returns the standard non-linearities, in ONNX' order.
    fn activations(self) -> &'static [&'static str] {
        match self {
            Self::Lstm => &["sigmoid", "tanh", "tanh"],
            Self::Gru { .. } => &["sigmoid", "tanh"],
        }
    }
}

/// Weights of one direction, transposed.
struct Cell {
    kind: Kind,
    input: Id,
    /// Recurrent weights: all gates of an LSTM; z and r, then h, of a GRU.
    recurrent: Vec<Id>,
    /// Bias that is added to the input's share.
    bias: Option<Id>,
    /// Biases that are added to the hidden state's shares, if not part of `bias`; else empty.
    recurrent_bias: Vec<Id>,
    hidden: usize,
}

/// Results of one direction: `h` of every step in time order, and the last `h` and `c`. All have
/// the shape `[batch, hidden]`.
struct Run {
    all: Vec<Id>,
    h: Id,
    c: Id,
}

/// Adds an LSTM to the graph. Inputs `X, W, R, B, sequence_lens, initial_h, initial_c, P`, outputs `Y, Y_h, Y_c`.
pub(super) fn lstm(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    x.at_most(7)?;
    a.only("input_forget", 0)?;
    unrolled(g, x, a, Kind::Lstm)
}

/// Adds a GRU to the graph. Inputs `X, W, R, B, sequence_lens, initial_h`, outputs `Y, Y_h`.
pub(super) fn gru(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    x.at_most(6)?;
    let linear_before_reset = a.flag("linear_before_reset", false)?;
    let mut all = unrolled(
        g,
        x,
        a,
        Kind::Gru {
            linear_before_reset,
        },
    )?;
    all.truncate(2);
    Ok(all)
}

fn unrolled(g: &mut Graph, x: &Operands, a: &Attributes, kind: Kind) -> Outputs {
    check(x, a, kind)?;
    let reverse: &[bool] = match a.text("direction")?.as_deref() {
        None | Some("forward") => &[false],
        Some("reverse") => &[true],
        Some("bidirectional") => &[false, true],
        Some(other) => return Err(format!("does not support direction = {other}")),
    };
    let batch_first = a.flag("layout", false)?;
    let hidden = a.int("hidden_size", -1)?;
    let mut value = x.get(0)?;
    if g.shape(value).len() != 3 {
        return Err("needs an input of three axes".into());
    }
    if batch_first {
        value = g.transpose(value, &[1, 0, 2])?;
    }
    let shape = g.known_shape(value).ok_or("supports static shapes only")?;
    let (steps, batch) = (shape[0], shape[1]);
    if steps > MAX_STEPS {
        return Err(format!("supports at most {MAX_STEPS} steps"));
    }
    let mut runs = vec![];
    for (direction, &reverse) in reverse.iter().enumerate() {
        let cell = cell(g, x, direction, kind)?;
        if hidden >= 0 && cell.hidden as i64 != hidden {
            return Err(format!(
                "has hidden_size = {hidden}, its weights have {}",
                cell.hidden
            ));
        }
        let mut start = |i: usize| -> Result<Option<Id>, String> {
            let Some(id) = x.optional(i) else {
                return Ok(None);
            };
            let id = if batch_first {
                g.transpose(id, &[1, 0, 2])?
            } else {
                id
            };
            let id = g.slice(id, 0, direction, 1)?;
            g.reshape(id, &[Dim::of(batch), Dim::of(cell.hidden)])
                .map(Some)
        };
        let (h, c) = (start(5)?, start(6)?);
        runs.push(run(g, value, &cell, (h, c), reverse)?);
    }
    outputs(g, &runs, steps, batch_first)
}

/// Refuses variants that the unrolled form does not compute.
fn check(x: &Operands, a: &Attributes, kind: Kind) -> Result<(), String> {
    if x.optional(4).is_some() {
        return Err("does not support sequence_lens".into());
    }
    if a.float("clip", f32::INFINITY)? != f32::INFINITY {
        return Err("does not support clip".into());
    }
    if let Some(names) = a.texts("activations")? {
        let standard = kind.activations();
        if names
            .iter()
            .enumerate()
            .any(|(i, name)| name.to_lowercase() != standard[i % standard.len()])
        {
            return Err(format!(
                "supports the activations {} only, not {}",
                standard.join(", "),
                names.join(", ")
            ));
        }
    }
    for name in ["activation_alpha", "activation_beta"] {
        if a.floats(name)?.is_some_and(|values| !values.is_empty()) {
            return Err(format!("does not support {name}"));
        }
    }
    Ok(())
}

fn cell(g: &mut Graph, x: &Operands, direction: usize, kind: Kind) -> Result<Cell, String> {
    let gates = kind.gates();
    let mut matrix = |id: Id| -> Result<Id, String> {
        let shape = g
            .known_shape(id)
            .filter(|shape| shape.len() == 3)
            .ok_or("needs weights of three axes")?;
        let one = g.slice(id, 0, direction, 1)?;
        let one = g.reshape(one, &[Dim::of(shape[1]), Dim::of(shape[2])])?;
        g.transpose(one, &[1, 0])
    };
    let (input, recurrent) = (matrix(x.get(1)?)?, matrix(x.get(2)?)?);
    let shape = g.known_shape(recurrent).unwrap_or_default();
    let hidden = shape[0];
    if shape[1] != gates * hidden {
        return Err(format!(
            "has recurrent weights of shape {shape:?}, not hidden by {gates} hidden"
        ));
    }
    let parts = |g: &mut Graph, id: Id, axis: usize| -> Result<Vec<Id>, String> {
        Ok(match kind {
            Kind::Lstm => vec![id],
            Kind::Gru { .. } => vec![
                g.slice(id, axis, 0, 2 * hidden)?,
                g.slice(id, axis, 2 * hidden, hidden)?,
            ],
        })
    };
    let (mut bias, mut recurrent_bias) = (None, vec![]);
    if let Some(id) = x.optional(3) {
        let len = gates * hidden;
        let own = g.slice(id, 0, direction, 1)?;
        let flat = g.reshape(own, &[Dim::of(2 * len)])?;
        let (input, recurrent) = (g.slice(flat, 0, 0, len)?, g.slice(flat, 0, len, len)?);
        if kind == Kind::Lstm {
            bias = Some(g.binary(BinaryKind::Add, input, recurrent)?);
        } else {
            bias = Some(input);
            recurrent_bias = parts(g, recurrent, 0)?;
        }
    }
    Ok(Cell {
        kind,
        input,
        recurrent: parts(g, recurrent, 1)?,
        bias,
        recurrent_bias,
        hidden,
    })
}

fn run(
    g: &mut Graph,
    x: Id,
    cell: &Cell,
    start: (Option<Id>, Option<Id>),
    reverse: bool,
) -> Result<Run, String> {
    let shape = g.known_shape(x).unwrap_or_default();
    let (steps, batch, n) = (shape[0], shape[1], cell.hidden);
    let mut shares = g.matmul(x, cell.input)?;
    if let Some(bias) = cell.bias {
        shares = g.binary(BinaryKind::Add, shares, bias)?;
    }
    let (mut h, mut c) = start;
    let mut all = vec![];
    for step in 0..steps {
        let t = if reverse { steps - 1 - step } else { step };
        let share = g.slice(shares, 0, t, 1)?;
        let share = g.reshape(share, &[Dim::of(batch), Dim::of(cell.kind.gates() * n)])?;
        let (out, next) = match cell.kind {
            Kind::Lstm => lstm_step(g, cell, share, h, c)?,
            Kind::Gru {
                linear_before_reset,
            } => {
                let out = gru_step(g, cell, share, h, linear_before_reset)?;
                (out, out)
            }
        };
        (h, c) = (Some(out), Some(next));
        all.push(out);
    }
    if reverse {
        all.reverse();
    }
    let (Some(h), Some(c)) = (h, c) else {
        return Err("has no steps".into());
    };
    Ok(Run { all, h, c })
}

/// Computes one step of an LSTM from the input's share of the gates: the new `h` and `c`.
fn lstm_step(
    g: &mut Graph,
    cell: &Cell,
    share: Id,
    h: Option<Id>,
    c: Option<Id>,
) -> Result<(Id, Id), String> {
    let n = cell.hidden;
    let mut gates = share;
    if let Some(h) = h {
        let recurrent = g.matmul(h, cell.recurrent[0])?;
        gates = g.binary(BinaryKind::Add, recurrent, gates)?;
    }
    let open = g.slice(gates, 1, 0, 3 * n)?;
    let open = g.unary(Unary::of(UnaryKind::Sigmoid), open)?;
    let (i, o, f) = (
        g.slice(open, 1, 0, n)?,
        g.slice(open, 1, n, n)?,
        g.slice(open, 1, 2 * n, n)?,
    );
    let candidate = g.slice(gates, 1, 3 * n, n)?;
    let candidate = g.unary(Unary::of(UnaryKind::Tanh), candidate)?;
    let mut next = g.binary(BinaryKind::Mul, i, candidate)?;
    if let Some(c) = c {
        let kept = g.binary(BinaryKind::Mul, f, c)?;
        next = g.binary(BinaryKind::Add, kept, next)?;
    }
    let bent = g.unary(Unary::of(UnaryKind::Tanh), next)?;
    Ok((g.binary(BinaryKind::Mul, o, bent)?, next))
}

/// Computes one step of a GRU from the input's share of the gates: the new `h`.
fn gru_step(
    g: &mut Graph,
    cell: &Cell,
    share: Id,
    h: Option<Id>,
    linear_before_reset: bool,
) -> Result<Id, String> {
    let n = cell.hidden;
    let sigmoid = Unary::of(UnaryKind::Sigmoid);
    // The hidden state's share of z and r or of h, with its bias; nothing without either.
    let recurrent = |g: &mut Graph, h: Option<Id>, part: usize| {
        let mut sum = None;
        if let Some(h) = h {
            sum = Some(g.matmul(h, cell.recurrent[part])?);
        }
        if let Some(&bias) = cell.recurrent_bias.get(part) {
            sum = Some(match sum {
                Some(sum) => g.binary(BinaryKind::Add, sum, bias)?,
                None => bias,
            });
        }
        Ok::<_, String>(sum)
    };
    let mut gates = g.slice(share, 1, 0, 2 * n)?;
    if let Some(sum) = recurrent(g, h, 0)? {
        gates = g.binary(BinaryKind::Add, sum, gates)?;
    }
    let gates = g.unary(sigmoid, gates)?;
    let (z, r) = (g.slice(gates, 1, 0, n)?, g.slice(gates, 1, n, n)?);
    let mut candidate = g.slice(share, 1, 2 * n, n)?;
    let added = if linear_before_reset {
        match recurrent(g, h, 1)? {
            Some(sum) => Some(g.binary(BinaryKind::Mul, r, sum)?),
            None => None,
        }
    } else {
        let reset = match h {
            Some(h) => Some(g.binary(BinaryKind::Mul, r, h)?),
            None => None,
        };
        recurrent(g, reset, 1)?
    };
    if let Some(added) = added {
        candidate = g.binary(BinaryKind::Add, candidate, added)?;
    }
    let candidate = g.unary(Unary::of(UnaryKind::Tanh), candidate)?;
    // (1 - z) * n + z * h = n + z * (h - n)
    if let Some(h) = h {
        let rest = g.binary(BinaryKind::Sub, h, candidate)?;
        let kept = g.binary(BinaryKind::Mul, z, rest)?;
        return g.binary(BinaryKind::Add, candidate, kept);
    }
    let lost = g.binary(BinaryKind::Mul, z, candidate)?;
    g.binary(BinaryKind::Sub, candidate, lost)
}

/// Assembles `Y [steps, directions, batch, hidden]`, `Y_h` and `Y_c [directions, batch, hidden]`;
/// with `layout` 1 the batch comes first.
fn outputs(g: &mut Graph, runs: &[Run], steps: usize, batch_first: bool) -> Outputs {
    let last = |g: &mut Graph, pick: fn(&Run) -> Id| -> Result<Id, String> {
        let parts = runs
            .iter()
            .map(|run| lead(g, pick(run)))
            .collect::<Result<Vec<_>, _>>()?;
        let y = g.concat(&parts, 0)?;
        if batch_first {
            g.transpose(y, &[1, 0, 2])
        } else {
            Ok(y)
        }
    };
    let (h, c) = (last(g, |run| run.h)?, last(g, |run| run.c)?);
    let mut rows = vec![];
    for t in 0..steps {
        for run in runs {
            rows.push(lead(g, run.all[t])?);
        }
    }
    let y = g.concat(&rows, 0)?;
    let mut shape = vec![Dim::of(steps), Dim::of(runs.len())];
    shape.extend_from_slice(&g.shape(y)[1..]);
    let y = g.reshape(y, &shape)?;
    let y = if batch_first {
        g.transpose(y, &[2, 0, 1, 3])?
    } else {
        y
    };
    Ok(vec![y, h, c])
}

/// Adds an axis of length one in front.
fn lead(g: &mut Graph, x: Id) -> Result<Id, String> {
    let shape = [&[Dim::of(1)], g.shape(x)].concat();
    g.reshape(x, &shape)
}
