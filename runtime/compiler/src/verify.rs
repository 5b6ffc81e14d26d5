//! Proves a memory plan, element by element, independent of how it was made.
//!
//! The program over the virtual arena, in which nothing overlaps, and the placed one are run side
//! by side without computing: every write records which virtual element, in which generation, an
//! element of the arena now holds; every read checks that it is still the expected one. So if two
//! live values overlapped, or an unwritten element was read, some read would find a different one.
//! The ops themselves must be the same but for their offsets.

use lads_image::op::{INT_SLOTS, Op, Place, Span};
use lads_image::{Access, AccessKind};

use crate::lower::Lowered;
use crate::plan::Placed;

/// Fault of a memory plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PlanFault {
    /// The plan changed more of an op than its offsets, or the number of ops or ports.
    #[error("op {op} is not the op that was planned")]
    Changed {
        /// Index of the op; the number of ops for a port.
        op: usize,
    },
    /// An op touches an element outside the arena.
    #[error("op {op} reaches element {element}, beyond the arena")]
    Bounds {
        /// Index of the op; the number of ops for a port.
        op: usize,
        /// Index of the element.
        element: usize,
    },
    /// An element is read that was never written.
    #[error("op {op} reads element {element}, which was never written")]
    Unwritten {
        /// Index of the op; the number of ops for an output.
        op: usize,
        /// Index of the element.
        element: usize,
    },
    /// An element is read after another value was written over it.
    #[error("op {op} reads element {element} after it was overwritten")]
    Overwritten {
        /// Index of the op; the number of ops for an output.
        op: usize,
        /// Index of the element.
        element: usize,
    },
    /// An integer is read that was never set.
    #[error("op {op} reads an integer that was never set")]
    Unset {
        /// Index of the op; the number of ops for an output.
        op: usize,
    },
}

/// Content of an element of the arena: a virtual element and its generation. Generation 0 means
/// unwritten.
type Content = (usize, u32);

struct State {
    /// Number of writes of each virtual element.
    generations: Vec<u32>,
    arena: Vec<Content>,
    ints: [bool; INT_SLOTS],
}

/// Proves that the placed program computes the same as the program over the virtual arena.
pub(crate) fn verify(planned: &Lowered, placed: &Placed) -> Result<(), PlanFault> {
    let end = planned
        .buffers
        .iter()
        .map(|buffer| buffer.offset as usize + buffer.len as usize)
        .max()
        .unwrap_or(0);
    let mut state = State {
        generations: vec![0; end],
        arena: vec![(0, 0); placed.arena_len as usize],
        ints: [false; INT_SLOTS],
    };
    let last = planned.ops.len();
    if placed.ops.len() != last {
        return Err(PlanFault::Changed { op: last });
    }
    for (from, to) in ports(&planned.inputs, &placed.inputs, last)? {
        state.port(from, to, last, State::write)?;
        if let Place::Int(slot) = to {
            state.ints[usize::from(slot.0)] = true;
        }
    }
    for (i, (from, to)) in planned.ops.iter().zip(&placed.ops).enumerate() {
        state.op(i, from, to)?;
    }
    for (from, to) in ports(&planned.outputs, &placed.outputs, last)? {
        state.port(from, to, last, State::read)?;
        if matches!(to, Place::Int(slot) if !state.ints[usize::from(slot.0)]) {
            return Err(PlanFault::Unset { op: last });
        }
    }
    Ok(())
}

/// Pairs the places of the same ports.
fn ports(
    planned: &[(String, Place)],
    placed: &[(String, Place)],
    op: usize,
) -> Result<Vec<(Place, Place)>, PlanFault> {
    let same = planned.len() == placed.len()
        && planned.iter().zip(placed).all(|(from, to)| from.0 == to.0);
    if !same {
        return Err(PlanFault::Changed { op });
    }
    Ok(planned
        .iter()
        .zip(placed)
        .map(|(from, to)| (from.1, to.1))
        .collect())
}

/// Returns an op with all its offsets zero.
fn without_offsets(op: &Op) -> Op {
    let mut op = *op;
    op.each_span(&mut |span| span.offset = 0);
    op
}

/// Returns the elements that an op reads, then those that it writes.
fn accesses(op: &Op) -> Vec<Access> {
    let mut all = vec![];
    op.accesses(&mut |access| all.push(access));
    all
}

type Touch = fn(&mut State, usize, usize, usize) -> Result<(), PlanFault>;

impl State {
    fn read(&mut self, op: usize, planned: usize, element: usize) -> Result<(), PlanFault> {
        let generation = self.generations.get(planned).copied().unwrap_or(0);
        let content = *self
            .arena
            .get(element)
            .ok_or(PlanFault::Bounds { op, element })?;
        match generation {
            0 => Err(PlanFault::Unwritten { op, element }),
            _ if content == (planned, generation) => Ok(()),
            _ => Err(PlanFault::Overwritten { op, element }),
        }
    }

    fn write(&mut self, op: usize, planned: usize, element: usize) -> Result<(), PlanFault> {
        let generation = self
            .generations
            .get_mut(planned)
            .ok_or(PlanFault::Changed { op })?;
        *generation += 1;
        *self
            .arena
            .get_mut(element)
            .ok_or(PlanFault::Bounds { op, element })? = (planned, *generation);
        Ok(())
    }

    fn pairs(
        &mut self,
        op: usize,
        from: Access,
        to: Access,
        touch: Touch,
    ) -> Result<(), PlanFault> {
        from.elements()
            .zip(to.elements())
            .try_for_each(|(planned, element)| touch(self, op, planned, element))
    }

    fn op(&mut self, i: usize, from: &Op, to: &Op) -> Result<(), PlanFault> {
        if without_offsets(from) != without_offsets(to) {
            return Err(PlanFault::Changed { op: i });
        }
        let slots = from.slots();
        if slots
            .read
            .is_some_and(|slot| !self.ints[usize::from(slot.0)])
        {
            return Err(PlanFault::Unset { op: i });
        }
        let pairs: Vec<(Access, Access)> = accesses(from).into_iter().zip(accesses(to)).collect();
        let of = |kind: AccessKind| pairs.iter().filter(move |(from, _)| from.kind == kind);
        for &(from, to) in of(AccessKind::Read) {
            self.pairs(i, from, to, Self::read)?;
        }
        for &(from, to) in of(AccessKind::Write) {
            self.pairs(i, from, to, Self::write)?;
        }
        // What one op writes to two places must not be the same place.
        for &(from, to) in of(AccessKind::Write) {
            self.pairs(i, from, to, Self::read)?;
        }
        if let Some(slot) = slots.written {
            self.ints[usize::from(slot.0)] = true;
        }
        Ok(())
    }

    /// Touches the elements of a port that is not an integer.
    fn port(&mut self, from: Place, to: Place, last: usize, touch: Touch) -> Result<(), PlanFault> {
        match (from, to) {
            (Place::Span(from), Place::Span(to)) if from.len == to.len => {
                let elements =
                    |span: Span| span.offset as usize..span.offset as usize + span.len as usize;
                elements(from)
                    .zip(elements(to))
                    .try_for_each(|(planned, element)| touch(self, last, planned, element))
            }
            (Place::Int(from), Place::Int(to)) if from == to => Ok(()),
            _ => Err(PlanFault::Changed { op: last }),
        }
    }
}
