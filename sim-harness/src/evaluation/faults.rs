//! Simulates a real robot's imperfections between policy and environment: late, lost and noisier observations, sluggish actuators.
//!
//! Invariants: faults of an episode depend only on its seed and on the faults themselves, never on threads; without faults every number
//! passes through bit for bit. What can fail: settings that mean nothing, before anything runs.

use std::collections::VecDeque;

use crate::environment::EpisodeSeed;
use crate::random::Stream;

/// Fourth number of the entropy of the stream that loses observations (the environment's noise has three, plan sampling has 1, uniform actions 3).
const DROP_STREAM: u64 = 4;

pub use lads_proof::faults::{FaultError, Faults, LONGEST_DELAY};

/// Simulates the faults in one episode.
#[derive(Debug)]
pub struct Link {
    faults: Faults,
    stream: Stream,
    /// Observations that have not arrived yet, the oldest first.
    late: VecDeque<Vec<f32>>,
    started: bool,
    /// Share of the last executed action in the next one.
    inertia: f64,
}

impl Link {
    /// Starts an episode.
    pub fn new(faults: Faults, seed: EpisodeSeed) -> Self {
        let [run, instruction, episode] = seed.entropy();
        let inertia = if faults.action_lag > 0.0 {
            (-1.0 / faults.action_lag).exp()
        } else {
            0.0
        };
        Self {
            faults,
            stream: Stream::new(&[run, instruction, episode, DROP_STREAM]),
            late: VecDeque::with_capacity(faults.delay_steps + 1),
            started: false,
            inertia,
        }
    }

    /// Computes what the policy sees (`seen`, which holds what it saw last) when the environment shows `observation`, which is `state` plus
    /// noise; a policy may see the first elements only.
    pub fn sense(&mut self, observation: &[f64], state: &[f64], seen: &mut [f32]) {
        let scale = self.faults.noise_scale;
        let noisy = observation
            .iter()
            .zip(state)
            .take(seen.len())
            .map(|(&shown, &truth)| {
                // Exactly what is shown where the noise is the environment's own.
                if scale == 1.0 {
                    shown as f32
                } else {
                    (truth + scale * (shown - truth)) as f32
                }
            });
        self.late.push_back(noisy.collect());
        let arrived = if self.late.len() > self.faults.delay_steps {
            self.late.pop_front()
        } else if self.started {
            None
        } else {
            self.late.front().cloned()
        };
        // One draw per observation, so that a rate of 0.2 loses all that 0.1 loses.
        let lost = self.stream.unit() < self.faults.drop_rate && self.started;
        self.started = true;
        if let Some(arrived) = arrived.filter(|_| !lost) {
            seen.copy_from_slice(&arrived);
        }
    }

    /// Computes what the actuators do (`executed`, which holds what they did last, zero at first) when the policy asks for `action`.
    pub fn actuate(&self, action: &[f32], executed: &mut [f32]) {
        for (done, &asked) in executed.iter_mut().zip(action) {
            *done = if self.inertia > 0.0 {
                let blended =
                    self.inertia * f64::from(*done) + (1.0 - self.inertia) * f64::from(asked);
                blended as f32
            } else {
                asked
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEED: EpisodeSeed = EpisodeSeed {
        seed: 3,
        instruction: 1,
        episode: 4,
    };

    /// Returns what is seen of the observations 0, 1, 2, ... of a state that is always half of them.
    fn seen(faults: Faults, steps: usize) -> Vec<f32> {
        let mut link = Link::new(faults, SEED);
        let mut seen = [f32::NAN];
        let see = |step: usize| {
            let shown = step as f64;
            link.sense(&[shown], &[shown / 2.0], &mut seen);
            seen[0]
        };
        (0..steps).map(see).collect()
    }

    #[test]
    fn without_faults_everything_passes() {
        assert_eq!(seen(Faults::default(), 4), [0.0, 1.0, 2.0, 3.0]);
        let link = Link::new(Faults::default(), SEED);
        let mut executed = [9.0, 9.0];
        link.actuate(&[0.1, -0.7], &mut executed);
        assert_eq!(executed, [0.1, -0.7]);
    }

    #[test]
    fn a_policy_may_see_the_first_elements_only() {
        let mut seen = [0.0; 2];
        Link::new(Faults::default(), SEED).sense(&[1.0, 2.0, 3.0], &[0.5; 3], &mut seen);
        assert_eq!(seen, [1.0, 2.0]);
    }

    #[test]
    fn a_delay_shows_the_first_observation_until_the_next_arrives() {
        let faults = Faults {
            delay_steps: 2,
            ..Faults::default()
        };
        assert_eq!(seen(faults, 6), [0.0, 0.0, 0.0, 1.0, 2.0, 3.0]);
    }

    #[test]
    fn lost_observations_leave_the_last_in_use() {
        let at = |drop_rate| {
            seen(
                Faults {
                    drop_rate,
                    ..Faults::default()
                },
                1_000,
            )
        };
        let fresh = |seen: &[f32]| {
            let fresh: Vec<usize> = (0..1_000).filter(|&i| seen[i] == i as f32).collect();
            fresh
        };
        assert_eq!(at(1.0), [0.0; 1_000]);
        let (some, more) = (fresh(&at(0.2)), fresh(&at(0.5)));
        // Binomial: within five standard deviations.
        assert!((some.len() as f64 - 800.0).abs() < 64.0, "{}", some.len());
        assert!((more.len() as f64 - 500.0).abs() < 80.0, "{}", more.len());
        assert!(
            more.iter().all(|step| some.contains(step)),
            "a higher rate loses more of the same"
        );
        assert_eq!(at(0.2), at(0.2));
    }

    #[test]
    fn noise_is_scaled_about_the_state() {
        let faults = Faults {
            noise_scale: 3.0,
            ..Faults::default()
        };
        assert_eq!(seen(faults, 3), [0.0, 2.0, 4.0]);
        let none = Faults {
            noise_scale: 0.0,
            ..Faults::default()
        };
        assert_eq!(seen(none, 3), [0.0, 0.5, 1.0]);
    }

    #[test]
    fn a_lag_closes_its_share_of_the_gap() {
        let faults = Faults {
            action_lag: 2.0,
            ..Faults::default()
        };
        let link = Link::new(faults, SEED);
        let mut executed = [0.0];
        for step in 1..20 {
            link.actuate(&[1.0], &mut executed);
            let wanted = 1.0 - (-f64::from(step) / 2.0).exp();
            assert!((f64::from(executed[0]) - wanted).abs() < 1e-6);
        }
    }

    #[test]
    fn settings_that_mean_nothing_are_named() {
        let faults = Faults::default();
        assert_eq!(faults.check(), Ok(()));
        let refused = |faults: Faults| faults.check().unwrap_err().to_string();
        assert!(
            refused(Faults {
                drop_rate: 1.1,
                ..faults
            })
            .contains("a drop rate of 1.1")
        );
        assert!(
            refused(Faults {
                drop_rate: f64::NAN,
                ..faults
            })
            .contains("a drop rate of NaN")
        );
        assert!(
            refused(Faults {
                noise_scale: -1.0,
                ..faults
            })
            .contains("a noise scale of -1")
        );
        assert!(
            refused(Faults {
                action_lag: f64::INFINITY,
                ..faults
            })
            .contains("an action lag of inf")
        );
        assert!(
            refused(Faults {
                delay_steps: 2_000,
                ..faults
            })
            .contains("a delay of 2000")
        );
    }
}
