//! Einstein sums over static shapes: sums over axes, transposes and one product for each two operands.

use lads_image::op::{BinaryKind, ReduceKind};

use super::Operands;
use super::attributes::Attributes;
use super::operators::Outputs;
use super::shapes::volume;
use crate::graph::{Dim, Graph, Id};

/// A value and the names of its axes.
struct Term {
    id: Id,
    axes: Vec<char>,
}

/// Adds an Einstein sum, operand by operand from the left.
pub(super) fn einsum(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let equation: String = a.text("equation")?.ok_or("misses its equation")?;
    let equation: String = equation.chars().filter(|c| !c.is_whitespace()).collect();
    let (left, right) = match equation.split_once("->") {
        Some((left, right)) => (left, Some(right)),
        None => (equation.as_str(), None),
    };
    let names: Vec<&str> = left.split(',').collect();
    let inputs = x.all()?;
    if names.len() != inputs.len() {
        return Err(format!(
            "names {} operands and has {}",
            names.len(),
            inputs.len()
        ));
    }
    let mut terms = vec![];
    for (names, &id) in names.iter().zip(&inputs) {
        let axes: Vec<char> = names.chars().collect();
        let plain = axes.iter().all(char::is_ascii_alphabetic);
        let twice = (1..axes.len()).any(|i| axes[..i].contains(&axes[i]));
        if !plain || twice || axes.len() != g.shape(id).len() {
            return Err(format!(
                "supports operands whose axes are named by letters, each once, not {names} of {}",
                crate::graph::show(g.shape(id))
            ));
        }
        terms.push(Term { id, axes });
    }
    let output: Vec<char> = if let Some(right) = right {
        right.chars().collect()
    } else {
        // What is named once, in the order of the alphabet.
        let count = |name: char| left.chars().filter(|&c| c == name).count();
        let once = left.chars().filter(|&c| c != ',' && count(c) == 1);
        let mut once: Vec<char> = once.collect();
        once.sort_unstable();
        once
    };
    let known = |name: &char| terms.iter().any(|term| term.axes.contains(name));
    if !output.iter().all(known) {
        return Err(format!("gives an axis that no operand has: {equation}"));
    }
    let mut rest = terms.into_iter();
    let mut sum = rest.next().ok_or("has no operand")?;
    let later: Vec<Term> = rest.collect();
    for (i, term) in later.iter().enumerate() {
        // Axes that are still needed after this product.
        let needed = |name: &char| {
            output.contains(name) || later[i + 1..].iter().any(|term| term.axes.contains(name))
        };
        let other = Term {
            id: term.id,
            axes: term.axes.clone(),
        };
        sum = product(g, sum, other, &needed)?;
    }
    let sum = summed(g, sum, |name| output.contains(name))?;
    turned(g, &sum, &output).map(|y| vec![y])
}

/// Sums a term over the axes that are no longer needed.
fn summed(g: &mut Graph, term: Term, needed: impl Fn(&char) -> bool) -> Result<Term, String> {
    let Term { mut id, mut axes } = term;
    for i in (0..axes.len()).rev() {
        if !needed(&axes[i]) {
            id = g.reduce(ReduceKind::Sum, id, i)?;
            axes.remove(i);
        }
    }
    Ok(Term { id, axes })
}

/// Transposes a term to another order of axes.
fn turned(g: &mut Graph, term: &Term, axes: &[char]) -> Result<Id, String> {
    let perm = axes
        .iter()
        .map(|name| term.axes.iter().position(|own| own == name));
    let perm: Option<Vec<usize>> = perm.collect();
    g.transpose(term.id, &perm.ok_or("loses an axis")?)
}

/// Multiplies two terms as matrices: `[both, left, inner]` by `[both, inner, right]`.
fn product(
    g: &mut Graph,
    a: Term,
    b: Term,
    needed: &impl Fn(&char) -> bool,
) -> Result<Term, String> {
    let (of_a, of_b) = (a.axes.clone(), b.axes.clone());
    let a = summed(g, a, |name| needed(name) || of_b.contains(name))?;
    let b = summed(g, b, |name| needed(name) || of_a.contains(name))?;
    let shared = |name: &&char| of_a.contains(name) && of_b.contains(name);
    let pick = |axes: &[char], keep: &dyn Fn(&char) -> bool| -> Vec<char> {
        axes.iter().copied().filter(|name| keep(name)).collect()
    };
    let both = pick(&a.axes, &|name| shared(&name) && needed(name));
    let inner = pick(&a.axes, &|name| shared(&name) && !needed(name));
    let left = pick(&a.axes, &|name| !shared(&name));
    let right = pick(&b.axes, &|name| !shared(&name));
    let lens = |g: &Graph, term: &Term, names: &[char]| -> Result<Vec<Dim>, String> {
        let len = |name| {
            let at = term.axes.iter().position(|own| own == name);
            at.map(|at| g.shape(term.id)[at])
                .ok_or_else(|| format!("loses axis {name}"))
        };
        names.iter().map(len).collect()
    };
    for names in [&both, &inner] {
        if lens(g, &a, names)? != lens(g, &b, names)? {
            return Err("has axes of one name and different lengths".into());
        }
    }
    let (batch, rows) = (lens(g, &a, &both)?, lens(g, &a, &left)?);
    let (middle, columns) = (lens(g, &a, &inner)?, lens(g, &b, &right)?);
    let x = turned(g, &a, &[&both[..], &left, &inner].concat())?;
    let y = turned(g, &b, &[&both[..], &inner, &right].concat())?;
    let mut shape = vec![];
    if !both.is_empty() {
        shape.push(volume(&batch)?);
    }
    let matrix = |g: &mut Graph, id, m: &[Dim], n: &[Dim]| {
        let dims = [&shape[..], &[volume(m)?, volume(n)?]].concat();
        g.reshape(id, &dims)
    };
    let (x, y) = (
        matrix(g, x, &rows, &middle)?,
        matrix(g, y, &middle, &columns)?,
    );
    let id = if middle.is_empty() {
        // An outer product.
        g.binary(BinaryKind::Mul, x, y)?
    } else {
        g.matmul(x, y)?
    };
    let id = g.reshape(id, &[&batch[..], &rows, &columns].concat())?;
    let axes = [both, left, right].concat();
    Ok(Term { id, axes })
}
