//! Arithmetic of a guard: limits, rates, the approach to the safe action.
//!
//! Invariants of a [`Limiter`]: its last action is finite and inside the limits; the safe action too. [`Limiter::write`] keeps
//! both, and the distance to the last action, compared exactly (in `f64`), never exceeds rate times period.

use lads_kernels::assign;

use super::GuardError;
use crate::contract::{Contract, Interval};

/// Limits that a guard enforces on an action; each list has one value per element of the action.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Limits<'c> {
    /// Smallest values; the contract's apply where they are narrower.
    pub min: Option<&'c [f32]>,
    /// Largest values; the contract's apply where they are narrower.
    pub max: Option<&'c [f32]>,
    /// Largest change, in units of the action per second; unlimited if `None`.
    pub max_rate: Option<&'c [f32]>,
    /// Action to move to when nothing else is known, and from which the first action starts; if
    /// `None`, zero or the limit nearest to it.
    pub safe_action: Option<&'c [f32]>,
}

/// Changes made to an action before it is executed.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Changed {
    pub saturated: bool,
    pub rate_limited: bool,
}

/// Limits and last value of one element of the action.
struct Slot<'s> {
    min: f32,
    max: f32,
    /// Largest change from one action to the next; infinite for no limit.
    max_step: f32,
    safe: f32,
    last: &'s mut f32,
}

/// Limits in use, in memory of the caller.
#[derive(Debug)]
pub(super) struct Limiter<'m> {
    min: &'m mut [f32],
    max: &'m mut [f32],
    max_step: &'m mut [f32],
    safe: &'m mut [f32],
    last: &'m mut [f32],
}

impl<'m> Limiter<'m> {
    /// Returns the number of elements of memory for actions of `action_len` elements.
    pub const fn memory_len(action_len: usize) -> usize {
        action_len.saturating_mul(5)
    }

    pub fn new(
        contract: &Contract,
        limits: &Limits,
        memory: &'m mut [f32],
    ) -> Result<Self, GuardError> {
        let (got, needed) = (memory.len(), Self::memory_len(contract.action_len()));
        let mut limiter =
            Self::split(memory, contract.action_len()).ok_or(GuardError::Memory { got, needed })?;
        limiter.configure(contract, limits)?;
        Ok(limiter)
    }

    fn split(memory: &'m mut [f32], len: usize) -> Option<Self> {
        let (min, memory) = memory.split_at_mut_checked(len)?;
        let (max, memory) = memory.split_at_mut_checked(len)?;
        let (max_step, memory) = memory.split_at_mut_checked(len)?;
        let (safe, memory) = memory.split_at_mut_checked(len)?;
        let (last, _) = memory.split_at_mut_checked(len)?;
        Some(Self {
            min,
            max,
            max_step,
            safe,
            last,
        })
    }

    fn configure(&mut self, contract: &Contract, limits: &Limits) -> Result<(), GuardError> {
        check(contract, limits)?;
        let places = self
            .min
            .iter_mut()
            .zip(self.max.iter_mut())
            .zip(self.max_step.iter_mut())
            .zip(self.safe.iter_mut());
        for (row, (((to_min, to_max), to_step), to_safe)) in rows(contract, limits).zip(places) {
            let row = row?;
            *to_min = row.min;
            *to_max = row.max;
            *to_step = row.max_step;
            *to_safe = row.safe;
        }
        assign(self.last, self.safe);
        Ok(())
    }

    /// Copies another limiter's values, the last action included; both have the same length.
    pub fn copy_from(&mut self, other: &Limiter) {
        assign(self.min, other.min);
        assign(self.max, other.max);
        assign(self.max_step, other.max_step);
        assign(self.safe, other.safe);
        assign(self.last, other.last);
    }

    /// Returns the last action that was written.
    pub fn last(&self) -> &[f32] {
        self.last
    }

    /// Records an action that was executed elsewhere as the last one, as far as the limits allow.
    pub fn executed(&mut self, action: &[f32]) {
        for (slot, &value) in self.slots().zip(action) {
            if value.is_finite() {
                *slot.last = within(value, slot.min, slot.max);
            }
        }
    }

    /// Replaces an action by the nearest one that the limits and the rates allow.
    pub fn write(&mut self, action: &mut [f32]) -> Changed {
        let mut changed = Changed::default();
        for (slot, value) in self.slots().zip(action) {
            // What is not a number never gets here; if it did, the last action would be the answer.
            let wanted = if value.is_nan() { *slot.last } else { *value };
            changed.saturated |= wanted <= slot.min || wanted >= slot.max;
            let inside = within(wanted, slot.min, slot.max);
            let reached = near(inside, *slot.last, slot.max_step);
            changed.rate_limited |= reached != inside;
            *slot.last = reached;
            *value = reached;
        }
        changed
    }

    /// Writes the point on the way from the last action to the safe one at `share` of the distance,
    /// from 0 (none) to 1 (all).
    pub fn write_towards_safe(&mut self, share: f32, action: &mut [f32]) -> Changed {
        for (slot, value) in self.slots().zip(action.iter_mut()) {
            *value = if share < 1.0 {
                let [last, safe, share] = [*slot.last, slot.safe, share].map(f64::from);
                (last + (safe - last) * share) as f32
            } else {
                slot.safe
            };
        }
        let changed = self.write(action);
        // The safe action may be at a limit; that is not a fault.
        Changed {
            saturated: false,
            ..changed
        }
    }

    fn slots(&mut self) -> impl Iterator<Item = Slot<'_>> {
        self.min
            .iter()
            .zip(self.max.iter())
            .zip(self.max_step.iter())
            .zip(self.safe.iter())
            .zip(self.last.iter_mut())
            .map(|((((&min, &max), &max_step), &safe), last)| Slot {
                min,
                max,
                max_step,
                safe,
                last,
            })
    }
}

/// Limits of one element of the action.
struct Row {
    min: f32,
    max: f32,
    max_step: f32,
    safe: f32,
}

/// Checks whether limits are valid for a policy.
pub(super) fn check(contract: &Contract, limits: &Limits) -> Result<(), GuardError> {
    let needed = contract.action_len();
    for list in [limits.min, limits.max, limits.max_rate, limits.safe_action] {
        let got = list.map_or(needed, <[f32]>::len);
        if got != needed {
            return Err(GuardError::Length { got, needed });
        }
    }
    rows(contract, limits).try_for_each(|row| row.map(|_| ()))
}

/// Returns the limits of each element of the action; the given limits are long enough.
fn rows<'l>(
    contract: &Contract<'l>,
    limits: &'l Limits,
) -> impl Iterator<Item = Result<Row, GuardError>> + use<'l> {
    let period = f64::from(contract.control_period_s());
    let allowed = contract.action_limits().enumerate();
    allowed.map(move |(index, allowed)| row(index, allowed, limits, period))
}

fn row(index: usize, allowed: Interval, limits: &Limits, period: f64) -> Result<Row, GuardError> {
    let at = |list: Option<&[f32]>| list.and_then(|list| list.get(index).copied());
    let [min, max] = [at(limits.min), at(limits.max)];
    let given = [min, max].into_iter().flatten().all(f32::is_finite);
    let min = min.map_or(allowed.min, |min| min.max(allowed.min));
    let max = max.map_or(allowed.max, |max| max.min(allowed.max));
    if !given || min > max {
        return Err(GuardError::Limits { index });
    }
    let rate = at(limits.max_rate);
    if rate.is_some_and(|rate| !rate.is_finite() || rate <= 0.0) {
        return Err(GuardError::Rate { index });
    }
    let inside = Interval { min, max };
    let safe = at(limits.safe_action).unwrap_or_else(|| inside.clamp(0.0));
    if !safe.is_finite() || inside.clamp(safe) != safe {
        return Err(GuardError::SafeAction { index });
    }
    Ok(Row {
        min,
        max,
        max_step: rate.map_or(f32::INFINITY, |rate| down(f64::from(rate) * period)),
        safe,
    })
}

fn within(value: f32, min: f32, max: f32) -> f32 {
    if value < min {
        min
    } else if value > max {
        max
    } else {
        value
    }
}

/// Returns the value nearest to `wanted` that is no further than `step` from `last`.
fn near(wanted: f32, last: f32, step: f32) -> f32 {
    let (wide, from, step) = (f64::from(wanted), f64::from(last), f64::from(step));
    if (wide - from).abs() <= step {
        wanted
    } else if wide > from {
        down(from + step)
    } else {
        -down(step - from)
    }
}

/// Returns the largest `f32` that is not above `x`.
fn down(x: f64) -> f32 {
    let rounded = x as f32;
    if f64::from(rounded) > x {
        rounded.next_down()
    } else {
        rounded
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_never_passes_the_step() {
        let mut seed = 1_u32;
        let mut next = || {
            seed = seed.wrapping_mul(1664525).wrapping_add(1013904223);
            f32::from_bits(seed)
        };
        let mut tried = 0;
        while tried < 100_000 {
            let [wanted, last, step] = [next(), next(), next().abs()];
            if ![wanted, last, step].iter().all(|x| x.is_finite()) {
                continue;
            }
            tried += 1;
            let reached = near(wanted, last, step);
            let [reached, from] = [reached, last].map(f64::from);
            assert!(
                (reached - from).abs() <= f64::from(step),
                "{wanted} {last} {step}"
            );
            // It is on the way.
            assert!((f64::from(wanted) - from) * (reached - from) >= 0.0);
        }
    }

    #[test]
    fn without_a_rate_everything_is_near() {
        assert_eq!(near(f32::MAX, f32::MIN, f32::INFINITY), f32::MAX);
        assert_eq!(near(1.0, 0.0, 0.25), 0.25);
        assert_eq!(near(-1.0, 0.0, 0.25), -0.25);
        assert_eq!(down(0.1), 0.099999994);
    }
}
