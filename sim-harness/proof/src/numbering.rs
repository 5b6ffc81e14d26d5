//! Detects plans that are the reference's under other numbers. The order of plans means nothing, if everything that uses it keeps to it.
//!
//! Invariant: a numbering is one to one. Nothing here can fail.

use std::collections::BTreeMap;

use crate::answers::Decision;

/// Maps each plan of the reference to the run's number of it; empty where the numbers are the same.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Numbering(Vec<u32>);

impl Numbering {
    /// Finds the numbering that explains all decisions, if the reference's own does not and another does: by the logits, which must be the
    /// reference's in another order within `tolerance`; without recorded logits by the plans, where margins are larger than `close_call`.
    pub fn of<'d>(
        decisions: impl Iterator<Item = Decision<'d>>,
        tolerance: f64,
        close_call: f64,
    ) -> Self {
        let decisions: Vec<_> = decisions.collect();
        let mut clear = decisions
            .iter()
            .filter(|decision| decision.margin > close_call);
        if clear.all(|decision| decision.plan == decision.reference) {
            return Self::default();
        }
        let with_logits = decisions.iter().all(|it| {
            !it.reference_logits.is_empty() && it.logits.len() == it.reference_logits.len()
        });
        let found = if with_logits {
            by_logits(&decisions, tolerance)
        } else {
            by_plans(&decisions, close_call)
        };
        Self(found.unwrap_or_default())
    }

    /// Whether the run's numbers differ from the reference's.
    pub fn is_another(&self) -> bool {
        !self.0.is_empty()
    }

    /// Returns the run's number of a plan of the reference.
    pub fn of_run(&self, reference: u32) -> u32 {
        self.0.get(reference as usize).copied().unwrap_or(reference)
    }
}

/// Subtracts the mean from logits, which does not depend on their order.
fn centred(logits: &[f32]) -> Vec<f64> {
    let mean = logits.iter().map(|&x| f64::from(x)).sum::<f64>() / logits.len().max(1) as f64;
    logits.iter().map(|&x| f64::from(x) - mean).collect()
}

fn by_logits(decisions: &[Decision<'_>], tolerance: f64) -> Option<Vec<u32>> {
    let len = decisions.first()?.logits.len();
    if decisions
        .iter()
        .any(|decision| decision.logits.len() != len)
    {
        return None;
    }
    let both: Vec<_> = decisions
        .iter()
        .map(|it| [centred(it.logits), centred(it.reference_logits)])
        .collect();
    let distance = |ours: usize, theirs: usize| {
        let each = both
            .iter()
            .map(|[run, reference]| (run[ours] - reference[theirs]).abs());
        each.fold(0.0, f64::max)
    };
    let mut free = vec![true; len];
    (0..len)
        .map(|theirs| {
            let best =
                (0..len).min_by(|&a, &b| distance(a, theirs).total_cmp(&distance(b, theirs)))?;
            // The means may be off by as much again.
            let fits = free[best] && distance(best, theirs) <= 2.0 * tolerance;
            free[best] = false;
            fits.then_some(best as u32)
        })
        .collect()
}

fn by_plans(decisions: &[Decision<'_>], close_call: f64) -> Option<Vec<u32>> {
    let mut number = BTreeMap::new();
    let mut taken = BTreeMap::new();
    for it in decisions.iter().filter(|it| it.margin > close_call) {
        if *number.entry(it.reference).or_insert(it.plan) != it.plan
            || *taken.entry(it.plan).or_insert(it.reference) != it.reference
        {
            return None;
        }
    }
    // Plans that were never decided keep to what is left, in order.
    let size = number.keys().chain(taken.keys()).max()? + 1;
    let mut left = (0..size).filter(|plan| !taken.contains_key(plan));
    (0..size)
        .map(|plan| number.get(&plan).copied().or_else(|| left.next()))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decision<'d>(
        plan: u32,
        reference: u32,
        logits: &'d [f32],
        reference_logits: &'d [f32],
    ) -> Decision<'d> {
        Decision {
            plan,
            reference,
            margin: 1.0,
            logits,
            reference_logits,
        }
    }

    #[test]
    fn another_order_is_found_by_the_logits() {
        let decisions = [
            decision(2, 0, &[1.0, 3.0, 7.0], &[7.5, 1.5, 3.5]),
            decision(1, 2, &[0.0, 5.0, 2.0], &[2.0, 0.0, 5.0]),
        ];
        let found = Numbering::of(decisions.into_iter(), 1e-3, 2e-3);
        assert_eq!(found, Numbering(vec![2, 0, 1]));
        assert_eq!([0, 1, 2, 9].map(|plan| found.of_run(plan)), [2, 0, 1, 9]);
    }

    #[test]
    fn other_logits_are_no_order() {
        let decisions = [decision(2, 0, &[1.0, 3.1, 7.0], &[7.5, 1.5, 3.5])];
        assert!(!Numbering::of(decisions.into_iter(), 1e-3, 2e-3).is_another());
    }

    #[test]
    fn without_logits_each_plan_must_always_be_the_same_other() {
        let of = |plans: &[(u32, u32)]| {
            let decisions: Vec<_> = plans
                .iter()
                .map(|&(plan, reference)| decision(plan, reference, &[], &[]))
                .collect();
            Numbering::of(decisions.into_iter(), 1e-3, 2e-3)
        };
        assert_eq!(of(&[(1, 0), (0, 1), (1, 0)]), Numbering(vec![1, 0]));
        assert_eq!(of(&[(1, 0), (0, 0)]), Numbering::default());
        assert_eq!(of(&[(1, 0), (1, 1)]), Numbering::default());
        assert_eq!(of(&[(0, 0), (1, 1)]), Numbering::default());
    }
}
