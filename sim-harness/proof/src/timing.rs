//! Durations of calls and episodes, and their percentiles.
//!
//! Nothing here can fail: over no durations a percentile is `None`.

use std::time::Duration;

use serde::Serialize;

/// Durations of everything, over all episodes of one driver.
#[derive(Debug, Clone, Default)]
pub struct Timing {
    /// Durations of the control steps that selected nothing, in nanoseconds.
    pub ordinary_ns: Vec<u64>,
    /// Durations of the control steps that selected an index, such as that of a plan, in nanoseconds.
    pub decision_ns: Vec<u64>,
    /// Durations of the changes of instruction, in nanoseconds.
    pub instruct_ns: Vec<u64>,
    /// CPU time inside the environment's reset and step, which is physics but for noise and task checks.
    pub simulator_cpu: Duration,
    /// CPU time inside the controller.
    pub controller_cpu: Duration,
    /// CPU time inside episodes as a whole.
    pub episodes_cpu: Duration,
}

impl Timing {
    /// Adds another driver's durations.
    pub fn absorb(&mut self, other: Self) {
        self.ordinary_ns.extend(other.ordinary_ns);
        self.decision_ns.extend(other.decision_ns);
        self.instruct_ns.extend(other.instruct_ns);
        self.simulator_cpu += other.simulator_cpu;
        self.controller_cpu += other.controller_cpu;
        self.episodes_cpu += other.episodes_cpu;
    }
}

/// Percentiles of a set of durations, in microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Latency {
    /// Number of durations.
    pub count: usize,
    /// Median; `None` without durations, like the other percentiles.
    pub p50: Option<f64>,
    /// 99th percentile; `None` without durations.
    pub p99: Option<f64>,
    /// Largest duration; `None` without durations.
    pub max: Option<f64>,
}

impl Latency {
    /// Computes percentiles of durations in nanoseconds, by nearest rank: the smallest duration that at least `p` percent do not exceed.
    pub fn of_ns(durations_ns: &[u64]) -> Self {
        let mut durations_ns = durations_ns.to_vec();
        durations_ns.sort_unstable();
        let at = |percent: usize| {
            let rank = (durations_ns.len() * percent).div_ceil(100);
            durations_ns
                .get(rank.checked_sub(1)?)
                .map(|&ns| ns as f64 / 1_000.0)
        };
        Self {
            count: durations_ns.len(),
            p50: at(50),
            p99: at(99),
            max: at(100),
        }
    }
}

/// Latency of the controller, in microseconds, by the kind of call.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LatencyByKind {
    /// Control steps that select nothing.
    pub ordinary: Latency,
    /// Control steps that select an index, such as that of a plan.
    pub decision: Latency,
    /// Setting an instruction, which runs its words through the policy.
    pub instruct: Latency,
}

impl LatencyByKind {
    /// Computes percentiles of all calls.
    pub fn of(timing: &Timing) -> Self {
        Self {
            ordinary: Latency::of_ns(&timing.ordinary_ns),
            decision: Latency::of_ns(&timing.decision_ns),
            instruct: Latency::of_ns(&timing.instruct_ns),
        }
    }
}

/// Use of time; CPU times are summed over the threads and do not depend on what else the machine does.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TimeUse {
    /// Wall time from the first episode to the last, in seconds.
    pub wall_s: f64,
    /// Number of threads that ran episodes.
    pub threads: usize,
    /// CPU time inside episodes, in seconds.
    pub episodes_cpu_s: f64,
    /// CPU time inside the environment's reset and step, in seconds: physics but for noise and task checks.
    pub simulator_cpu_s: f64,
    /// CPU time inside the controller, in seconds.
    pub controller_cpu_s: f64,
    /// `simulator_cpu_s` over `episodes_cpu_s`; `None` without episodes.
    pub simulator_share: Option<f64>,
}

impl TimeUse {
    /// Sums up the measured durations.
    pub fn of(timing: &Timing, wall: Duration, threads: usize) -> Self {
        let (simulator_cpu_s, episodes_cpu_s) = (
            timing.simulator_cpu.as_secs_f64(),
            timing.episodes_cpu.as_secs_f64(),
        );
        Self {
            wall_s: wall.as_secs_f64(),
            threads,
            episodes_cpu_s,
            simulator_cpu_s,
            controller_cpu_s: timing.controller_cpu.as_secs_f64(),
            simulator_share: (episodes_cpu_s > 0.0).then(|| simulator_cpu_s / episodes_cpu_s),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_nearest_rank() {
        let durations: Vec<u64> = (1..=200).rev().map(|x| x * 1_000).collect();
        let latency = Latency::of_ns(&durations);
        assert_eq!(
            (latency.count, latency.p50, latency.p99, latency.max),
            (200, Some(100.0), Some(198.0), Some(200.0))
        );
        let one = Latency::of_ns(&[1_500]);
        assert_eq!(
            (one.p50, one.p99, one.max),
            (Some(1.5), Some(1.5), Some(1.5))
        );
        assert_eq!(
            Latency::of_ns(&[]),
            Latency {
                count: 0,
                p50: None,
                p99: None,
                max: None
            }
        );
    }
}
