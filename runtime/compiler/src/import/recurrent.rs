//! The LSTM, unrolled: the horizon is static, so every step becomes operations of its own.
//!
//! With the gates in ONNX' order i, o, f, c (Hochreiter & Schmidhuber 1997, with forget gates):
//! `g = x_t·W^T + h·R^T + Wb + Rb`, `c = sigmoid(g_f) * c + sigmoid(g_i) * tanh(g_c)`, `h = sigmoid(g_o) * tanh(c)`.
//! The input's share of all steps is one product.

use lads_image::op::{BinaryKind, UnaryKind};

use super::Operands;
use super::attributes::Attributes;
use super::operators::Outputs;
use crate::graph::{Dim, Graph, Id, Unary};

/// The most steps that are unrolled.
const MAX_STEPS: usize = 512;

/// Weights of one direction, transposed.
struct Cell {
    input: Id,
    recurrent: Id,
    bias: Option<Id>,
    hidden: usize,
}

/// What one direction gives: `h` of every step in time order, and the last `h` and `c`. All `[batch, hidden]`.
struct Run {
    all: Vec<Id>,
    h: Id,
    c: Id,
}

/// Adds an LSTM to the graph. Inputs `X, W, R, B, sequence_lens, initial_h, initial_c, P`, outputs `Y, Y_h, Y_c`.
pub(super) fn lstm(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    check(x, a)?;
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
        let cell = cell(g, x, direction)?;
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

/// Refuses what the unrolled form does not compute.
fn check(x: &Operands, a: &Attributes) -> Result<(), String> {
    x.at_most(7)?;
    if x.optional(4).is_some() {
        return Err("does not support sequence_lens".into());
    }
    a.only("input_forget", 0)?;
    if a.float("clip", f32::INFINITY)? != f32::INFINITY {
        return Err("does not support clip".into());
    }
    if let Some(names) = a.texts("activations")? {
        let standard = ["sigmoid", "tanh", "tanh"];
        if names
            .iter()
            .enumerate()
            .any(|(i, name)| name.to_lowercase() != standard[i % 3])
        {
            return Err(format!(
                "supports the activations Sigmoid, Tanh, Tanh only, not {}",
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

fn cell(g: &mut Graph, x: &Operands, direction: usize) -> Result<Cell, String> {
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
    if shape[1] != 4 * hidden {
        return Err(format!(
            "has recurrent weights of shape {shape:?}, not hidden by 4 hidden"
        ));
    }
    let bias = match x.optional(3) {
        None => None,
        Some(id) => {
            let own = g.slice(id, 0, direction, 1)?;
            let flat = g.reshape(own, &[Dim::of(8 * hidden)])?;
            let (input, recurrent) = (
                g.slice(flat, 0, 0, 4 * hidden)?,
                g.slice(flat, 0, 4 * hidden, 4 * hidden)?,
            );
            Some(g.binary(BinaryKind::Add, input, recurrent)?)
        }
    };
    Ok(Cell {
        input,
        recurrent,
        bias,
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
        let mut gates = g.reshape(share, &[Dim::of(batch), Dim::of(4 * n)])?;
        if let Some(h) = h {
            let recurrent = g.matmul(h, cell.recurrent)?;
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
        let out = g.binary(BinaryKind::Mul, o, bent)?;
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

/// `Y [steps, directions, batch, hidden]`, `Y_h` and `Y_c [directions, batch, hidden]`; with `layout` 1 the batch comes first.
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

/// An axis of length one in front.
fn lead(g: &mut Graph, x: Id) -> Result<Id, String> {
    let shape = [&[Dim::of(1)], g.shape(x)].concat();
    g.reshape(x, &shape)
}
