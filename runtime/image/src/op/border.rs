//! Fills the border of an image, so that every pixel of a convolution is computed alike.

use super::picture::{Pair, called};
use super::{Operation, Work};
use crate::access::{self, Access, AccessKind};
use crate::check::{Checked, Checker, Fault, exactly, require};
use crate::codec::record;
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{Span, WeightSpan};

record! {
    /// Fills the border of an image; the pixels inside keep their value.
    pub struct Border {
        /// Image `[before + inside + after rows, before + inside + after columns, c]`, contiguous.
        pub y: Span,
        /// Size of the image without its border.
        pub inside: Pair,
        /// Number of border rows above and border columns to the left.
        pub before: Pair,
        /// Number of border rows below and border columns to the right.
        pub after: Pair,
        /// Number of channels.
        pub c: u32,
        /// Value of a border pixel, `[c]`; zeros if `None`.
        pub value: Option<WeightSpan>,
    }
}

impl Border {
    /// Returns the number of rows and columns, border included.
    fn whole(&self) -> [u32; 2] {
        let [before, inside, after] = [self.before, self.inside, self.after].map(Pair::words);
        let sum = |[a, b, c]: [u32; 3]| a.saturating_add(b).saturating_add(c);
        let ([b0, b1], [i0, i1], [a0, a1]) = (before, inside, after);
        [sum([b0, i0, a0]), sum([b1, i1, a1])]
    }

    /// Returns the four sides: first element, rows, and elements of each.
    fn sides(&self) -> [[u32; 3]; 4] {
        let line = self.line();
        let [above, left] = self.before.words();
        let [below, right] = self.after.words();
        let [rows, cols] = self.inside.words();
        let inner = above.saturating_mul(line);
        let wide = |columns: u32| columns.saturating_mul(self.c);
        [
            [0, above, line],
            [inner, rows, wide(left)],
            [
                inner.saturating_add(wide(left.saturating_add(cols))),
                rows,
                wide(right),
            ],
            [inner.saturating_add(rows.saturating_mul(line)), below, line],
        ]
    }

    /// Returns the number of elements of a row.
    fn line(&self) -> u32 {
        let [_, cols] = self.whole();
        cols.saturating_mul(self.c)
    }
}

impl Operation for Border {
    fn check(&self, checker: &Checker) -> Checked {
        checker.arena(self.y)?;
        self.inside.positive()?;
        let [rows, cols] = self.whole();
        exactly(self.y.len, [rows, cols, self.c])?;
        let bare = [self.before, self.after].map(Pair::words) == [[0; 2]; 2];
        require(!bare, Fault::Shape)?;
        self.value.map_or(Ok(()), |value| {
            checker.weights(value)?;
            exactly(value.len, [self.c])
        })
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        called(|| {
            let (read, y) = Readable::cut(weights, machine.arena, self.y)?;
            let value = match self.value {
                Some(value) => Some(read.get(value.into())?),
                None => None,
            };
            for [first, rows, len] in self.sides() {
                let side = y.get_mut(first as usize..).unwrap_or(&mut []);
                for row in side
                    .chunks_mut(self.line().max(1) as usize)
                    .take(rows as usize)
                {
                    let row = row.get_mut(..len as usize).unwrap_or(&mut []);
                    match value {
                        None => row.fill(0.0),
                        Some(value) => {
                            let values = value.iter().cycle();
                            row.iter_mut().zip(values).for_each(|(y, &x)| *y = x);
                        }
                    }
                }
            }
            Ok(())
        })
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        for [first, rows, len] in self.sides() {
            let side = Span {
                offset: self.y.offset.saturating_add(first),
                len: 0,
            };
            let (dims, strides) = ([1, 1, rows, len], [0, 0, self.line(), 1]);
            see(Access::strided(AccessKind::Write, side, dims, strides));
        }
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_span(&mut self.y, visit);
    }

    fn work(&self) -> Work {
        let filled = |work: Work, [_, rows, len]: [u32; 3]| work.and(Work::products([rows, len]));
        self.sides()
            .into_iter()
            .fold(Work::default(), filled)
            .with_weights(self.value)
    }
}

#[cfg(test)]
mod tests {
    use super::{Border, Pair};
    use crate::op::tests::{computed, span};
    use crate::place::WeightSpan;

    #[test]
    fn what_lies_inside_stays() {
        let border = Border {
            y: span(1, 24),
            inside: Pair { rows: 1, cols: 2 },
            before: Pair { rows: 1, cols: 1 },
            after: Pair { rows: 1, cols: 1 },
            c: 2,
            value: Some(WeightSpan { offset: 1, len: 2 }),
        };
        let mut arena = [7.0; 26];
        let filled = computed(border, &arena, &[0.0, 1.0, 2.0]);
        for (i, x) in arena.iter_mut().enumerate() {
            *x = match i {
                0 | 25 | 11..15 => 7.0,
                odd if odd % 2 == 1 => 1.0,
                _ => 2.0,
            };
        }
        assert_eq!(filled, arena);
        let zeros = Border {
            value: None,
            after: Pair::of(0),
            y: span(1, 12),
            ..border
        };
        let filled = computed(zeros, &[7.0; 13], &[]);
        let expected = [
            7.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 7.0, 7.0, 7.0, 7.0,
        ];
        assert_eq!(filled, expected);
    }
}
