//! Conversions between numbers in the arena and integers in slots.

use super::{Operation, Slots, Work};
use crate::access::{self, Access};
use crate::check::{Checked, Checker, exactly};
use crate::codec::record;
use crate::machine::{ExecError, Machine};
use crate::place::{IntSlot, Span};

record! {
    /// Conversion to an integer, `out = trunc(x)`: an index that a policy computes. A number up to
    /// -1, NaN, or a number from 2^31 on becomes `u32::MAX`, which is outside every table.
    pub struct ToIndex {
        /// Number to convert, one element.
        pub x: Span,
        /// Slot of the resulting integer.
        pub out: IntSlot,
    }
}

record! {
    /// Conversion to a float, `y = index + shift`.
    pub struct FromIndex {
        /// Slot that holds the integer.
        pub index: IntSlot,
        /// Number added to the integer.
        pub shift: i32,
        /// Result, one element.
        pub y: Span,
    }
}

impl Operation for ToIndex {
    fn check(&self, checker: &Checker) -> Checked {
        checker.arena(self.x)?;
        exactly(self.x.len, [1])
    }

    #[inline]
    fn run(&self, _weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let x = machine.arena.get(self.x.range()).and_then(<[f32]>::first);
        let &x = x.ok_or(ExecError::Span)?;
        // A cast rounds towards zero.
        let fits = x > -1.0 && x < 2_147_483_648.0;
        machine.set_int(self.out, if fits { x as u32 } else { u32::MAX });
        Ok(())
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        access::read(self.x.into(), see);
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_span(&mut self.x, visit);
    }

    fn slots(&self) -> Slots {
        Slots {
            read: None,
            written: Some(self.out),
        }
    }

    fn work(&self) -> Work {
        Work::elements(1)
    }
}

impl Operation for FromIndex {
    fn check(&self, checker: &Checker) -> Checked {
        checker.arena(self.y)?;
        exactly(self.y.len, [1])
    }

    #[inline]
    fn run(&self, _weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let number = i64::from(machine.int(self.index)).saturating_add(i64::from(self.shift));
        let y = machine.arena.get_mut(self.y.range());
        let y = y.and_then(<[f32]>::first_mut).ok_or(ExecError::Span)?;
        *y = number as f32;
        Ok(())
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        access::write(self.y, see);
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_span(&mut self.y, visit);
    }

    fn slots(&self) -> Slots {
        Slots {
            read: Some(self.index),
            written: None,
        }
    }

    fn work(&self) -> Work {
        Work::elements(1)
    }
}

#[cfg(test)]
mod tests {
    use super::{FromIndex, ToIndex};
    use crate::op::tests::{run, span};
    use crate::place::{INT_SLOTS, IntSlot};

    #[test]
    fn numbers_become_integers_and_back() {
        for (x, expected) in [
            (0.0, 0),
            (-0.9, 0),
            (3.99, 3),
            (16_777_216.0, 16_777_216),
            (-1.0, u32::MAX),
            (f32::NAN, u32::MAX),
            (f32::INFINITY, u32::MAX),
            (2_147_483_648.0, u32::MAX),
        ] {
            let out = IntSlot(2);
            let op = ToIndex { x: span(1, 1), out };
            let (_, ints) = run(op, &[9.0, x], &[], [7; INT_SLOTS]).unwrap();
            assert_eq!((ints[2], ints[1]), (expected, 7), "{x}");
        }
        let op = FromIndex {
            index: IntSlot(2),
            shift: -9,
            y: span(1, 1),
        };
        let (arena, _) = run(op, &[5.0, 5.0], &[], [7; INT_SLOTS]).unwrap();
        assert_eq!(arena, [5.0, -2.0]);
    }
}
