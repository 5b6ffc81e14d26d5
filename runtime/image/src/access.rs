//! Arena elements that an op reads and writes, from which a memory plan is proven.
//!
//! An [`Access`] is exact: gaps between strided elements are not part of it. The order of an op's
//! accesses and of their elements depends on the op's shape alone, so the accesses of an op before
//! and after its spans were moved pair off. Numbers saturate; nothing here can fail.

use crate::place::{Operand, Span};

/// Use that an op makes of the elements of an [`Access`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AccessKind {
    /// The op reads the elements before it writes anything.
    Read,
    /// The op writes the elements; scratch counts as written.
    Write,
}

/// Strided elements of the arena: `offset + i * strides[0] + ..` for all indices below `dims`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Access {
    /// Use of the elements.
    pub kind: AccessKind,
    /// Offset of the first element.
    pub offset: u32,
    /// Number of elements in each dimension.
    pub dims: [u32; 4],
    /// Distance from one element to the next in each dimension.
    pub strides: [u32; 4],
}

impl Access {
    /// Makes an access to all elements of a span.
    pub const fn all(kind: AccessKind, span: Span) -> Self {
        Self::strided(kind, span, [1, 1, 1, span.len], [0, 0, 0, 1])
    }

    /// Makes an access to strided elements from the start of a span.
    pub const fn strided(kind: AccessKind, span: Span, dims: [u32; 4], strides: [u32; 4]) -> Self {
        Self {
            kind,
            offset: span.offset,
            dims,
            strides,
        }
    }

    /// Makes an access to rows that start `stride` elements apart, the last of which ends the span.
    pub const fn rows(kind: AccessKind, span: Span, rows: u32, stride: u32) -> Self {
        let before = rows.saturating_sub(1).saturating_mul(stride);
        let width = span.len.saturating_sub(before);
        Self::strided(kind, span, [1, 1, rows, width], [0, 0, stride, 1])
    }

    /// Returns the indices of the elements, in row-major order.
    pub fn elements(self) -> impl Iterator<Item = usize> {
        let [a, b, c, d] = self.dims;
        let [sa, sb, sc, sd] = self.strides;
        steps(self.offset as usize, a, sa)
            .flat_map(move |at| steps(at, b, sb))
            .flat_map(move |at| steps(at, c, sc))
            .flat_map(move |at| steps(at, d, sd))
    }
}

/// Returns `dim` indices, `stride` apart, from `start`.
fn steps(start: usize, dim: u32, stride: u32) -> impl Iterator<Item = usize> {
    (0..dim as usize).map(move |i| start.saturating_add(i.saturating_mul(stride as usize)))
}

/// Reports a read of all of an operand that lies in the arena.
pub(crate) fn read(operand: Operand, see: &mut dyn FnMut(Access)) {
    if let Some(span) = operand.arena() {
        see(Access::all(AccessKind::Read, span));
    }
}

/// Reports a read of strided elements of an operand that lies in the arena.
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

/// Reports a write of all of a span.
pub(crate) fn write(span: Span, see: &mut dyn FnMut(Access)) {
    see(Access::all(AccessKind::Write, span));
}

/// Visits a span unless it is empty.
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
