//! The index of the smallest or the largest element.

use lads_kernels as kernels;

use super::{Operation, Slots, Work};
use crate::access::{self, Access};
use crate::check::{Checked, Checker};
use crate::codec::record;
use crate::machine::{ExecError, Machine};
use crate::place::{IntSlot, Span};

record! {
    /// Index of the smallest element, `out = argmin(x)`, the first of equal ones.
    pub struct ArgMin {
        /// Elements to search.
        pub x: Span,
        /// Slot of the resulting index.
        pub out: IntSlot,
    }
}

record! {
    /// Index of the largest element, `out = argmax(x)`, the first of equal ones.
    pub struct ArgMax {
        /// Elements to search.
        pub x: Span,
        /// Slot of the resulting index.
        pub out: IntSlot,
    }
}

/// Implements [`Operation`] for [`ArgMin`] and [`ArgMax`], which differ only in their kernel.
macro_rules! arg {
    ($name:ident by $kernel:path) => {
        impl Operation for $name {
            fn check(&self, checker: &Checker) -> Checked {
                checker.arena(self.x)
            }

            #[inline]
            fn run(&self, _weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
                let x = machine.arena.get(self.x.range()).ok_or(ExecError::Span)?;
                machine.set_int(self.out, $kernel(x) as u32);
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
                Work::elements(self.x.len)
            }
        }
    };
}

arg! { ArgMin by kernels::arg_min }
arg! { ArgMax by kernels::arg_max }

#[cfg(test)]
mod tests {
    use super::{ArgMax, ArgMin};
    use crate::op::tests::{run, span};
    use crate::place::{INT_SLOTS, IntSlot};

    #[test]
    fn the_first_of_equal_ones_is_found() {
        let (x, out) = (span(1, 4), IntSlot(3));
        let arena = [-9.0, 2.0, -1.0, 2.0, -1.0, 9.0];
        let mut ints = [7; INT_SLOTS];
        for (found, expected) in [
            (run(ArgMax { x, out }, &arena, &[], ints), 0),
            (run(ArgMin { x, out }, &arena, &[], ints), 1),
        ] {
            ints[3] = expected;
            assert_eq!(found, Ok((arena.to_vec(), ints)));
        }
    }
}
