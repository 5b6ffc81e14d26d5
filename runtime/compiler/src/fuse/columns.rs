//! Moves a permutation of a layer's input columns into the rows of its matrix, so that the layer
//! reads the columns in their stored order.
//!
//! Joints in a policy's order are columns picked one by one from the robot's order. The sum of a
//! layer is the same in any order of its terms, up to rounding, so nothing has to be moved at run
//! time.

use crate::graph::{Graph, Id, Op};

/// Columns `start..start + len` of a value, with the matrix rows from `row` on that belong to them.
#[derive(Debug, Clone, Copy)]
struct Piece {
    source: Id,
    start: usize,
    len: usize,
    row: usize,
}

/// Returns the operands of `x·W` with fewer pieces, if possible.
pub(super) fn sorted(g: &mut Graph, x: Id, matrix: Id) -> Result<Option<(Id, Id)>, String> {
    let Some(axis) = g.shape(x).len().checked_sub(1) else {
        return Ok(None);
    };
    let mut pieces = vec![];
    if take(g, x, axis, &mut pieces).is_none() {
        return Ok(None);
    }
    let before = pieces.len();
    let sources: Vec<Id> = pieces.iter().map(|piece| piece.source).collect();
    let first = |source| sources.iter().position(|&known| known == source);
    pieces.sort_by_key(|piece| (first(piece.source), piece.start));
    let joins = |a: &Piece, b: &Piece| a.source == b.source && a.start + a.len == b.start;
    let runs: Vec<Piece> = pieces
        .chunk_by(joins)
        .map(|run| Piece {
            len: run.iter().map(|piece| piece.len).sum(),
            ..run[0]
        })
        .collect();
    if runs.len() == before {
        return Ok(None);
    }
    let mut parts = vec![];
    for Piece {
        source, start, len, ..
    } in runs
    {
        parts.push(g.slice(source, axis, start, len)?);
    }
    let mut rows = vec![];
    for Piece { row, len, .. } in pieces {
        rows.push(g.slice(matrix, 0, row, len)?);
    }
    Ok(Some((g.concat(&parts, axis)?, g.concat(&rows, 0)?)))
}

/// Splits a value into its pieces; `None` if a length is not known.
fn take(g: &Graph, x: Id, axis: usize, pieces: &mut Vec<Piece>) -> Option<()> {
    let len = g.shape(x)[axis].known()?;
    let row = pieces.last().map_or(0, |last| last.row + last.len);
    match *g.op(x) {
        Op::Concat { axis: along } if along == axis => {
            for &part in &g.node(x).inputs {
                take(g, part, axis, pieces)?;
            }
        }
        Op::Slice { axis: along, start } if along == axis => pieces.push(Piece {
            source: g.node(x).inputs[0],
            start,
            len,
            row,
        }),
        _ => pieces.push(Piece {
            source: x,
            start: 0,
            len,
            row,
        }),
    }
    Some(())
}
