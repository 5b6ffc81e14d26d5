//! Which elements of the arena an op reads and writes: what a memory plan is proven with.
//!
//! An [`Access`] is exact: gaps between strided elements are no part of it. The order of an op's accesses and of their elements
//! depends on the op's shape alone, so the accesses of an op before and after its spans were moved pair off. Numbers saturate;
//! nothing here can fail.

use crate::place::{Operand, Span};

/// What an op does to the elements of an [`Access`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AccessKind {
    /// Reads them, before it writes anything.
    Read,
    /// Writes them; scratch is written.
    Write,
}

/// Strided elements: `offset + i * strides[0] + ..` for all indices below `dims`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Access {
    /// What is done to them.
    pub kind: AccessKind,
    /// The first element.
    pub offset: u32,
    /// How many there are in each dimension.
    pub dims: [u32; 4],
    /// Elements from one to the next in each dimension.
    pub strides: [u32; 4],
}

impl Access {
    /// All elements of a span.
    pub const fn all(kind: AccessKind, span: Span) -> Self {
        Self::strided(kind, span, [1, 1, 1, span.len], [0, 0, 0, 1])
    }

    /// Elements from the start of a span.
    pub const fn strided(kind: AccessKind, span: Span, dims: [u32; 4], strides: [u32; 4]) -> Self {
        Self {
            kind,
            offset: span.offset,
            dims,
            strides,
        }
    }

    /// Rows that start `stride` elements apart, the last of which ends the span.
    pub const fn rows(kind: AccessKind, span: Span, rows: u32, stride: u32) -> Self {
        let before = rows.saturating_sub(1).saturating_mul(stride);
        let width = span.len.saturating_sub(before);
        Self::strided(kind, span, [1, 1, rows, width], [0, 0, stride, 1])
    }

    /// The elements, in row-major order.
    pub fn elements(self) -> impl Iterator<Item = usize> {
        let [a, b, c, d] = self.dims;
        let [sa, sb, sc, sd] = self.strides;
        steps(self.offset as usize, a, sa)
            .flat_map(move |at| steps(at, b, sb))
            .flat_map(move |at| steps(at, c, sc))
            .flat_map(move |at| steps(at, d, sd))
    }
}

/// `dim` elements from `start`.
fn steps(start: usize, dim: u32, stride: u32) -> impl Iterator<Item = usize> {
    (0..dim as usize).map(move |i| start.saturating_add(i.saturating_mul(stride as usize)))
}

/// Reads all of an operand that lies in the arena.
pub(crate) fn read(operand: Operand, see: &mut dyn FnMut(Access)) {
    if let Some(span) = operand.arena() {
        see(Access::all(AccessKind::Read, span));
    }
}

/// Reads strided elements of an operand that lies in the arena.
pub(crate) fn read_strided(
    operand: Operand,
    dims: [u32; 4],
    strides: [u32; 4],
    see: &mut dyn FnMut(Access),
) {
    if let Some(span) = operand.arena() {
        see(Access::strided(AccessKind::Read, span, dims, strides));
    }
}

/// Writes all of a span.
pub(crate) fn write(span: Span, see: &mut dyn FnMut(Access)) {
    see(Access::all(AccessKind::Write, span));
}

/// Visits a span that is not empty.
pub(crate) fn visit_span(span: &mut Span, visit: &mut dyn FnMut(&mut Span)) {
    if span.len > 0 {
        visit(span);
    }
}

/// Visits the span of an operand that lies in the arena.
pub(crate) fn visit_operand(operand: &mut Operand, visit: &mut dyn FnMut(&mut Span)) {
    if let Some(mut span) = operand.arena() {
        visit_span(&mut span, visit);
        (operand.offset, operand.len) = (span.offset, span.len);
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::{Access, AccessKind};
    use crate::place::Span;

    #[test]
    fn rows_leave_out_the_gaps() {
        let span = Span { offset: 10, len: 8 };
        let rows = Access::rows(AccessKind::Read, span, 2, 5);
        let elements: Vec<usize> = rows.elements().collect();
        assert_eq!(elements, [10, 11, 12, 15, 16, 17]);
        let all = Access::all(AccessKind::Write, span);
        assert!(all.elements().eq(10..18));
    }

    #[test]
    fn elements_are_in_row_major_order() {
        let span = Span { offset: 1, len: 0 };
        let transposed = Access::strided(AccessKind::Read, span, [1, 2, 1, 3], [9, 1, 9, 2]);
        let elements: Vec<usize> = transposed.elements().collect();
        assert_eq!(elements, [1, 3, 5, 2, 4, 6]);
    }
}
