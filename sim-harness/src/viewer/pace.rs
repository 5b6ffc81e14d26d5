//! Decides when the next control step is due: at absolute deadlines, a control period apart, so that errors of waiting do not add up. What
//! can fail: nothing; a step that comes later than a whole period, as after a pause, moves the deadlines after it instead of racing them.

use std::time::{Duration, Instant};

/// Slowest and fastest speed, as powers of two of real time.
const SLOWEST: i32 = -4;
const FASTEST: i32 = 4;

/// Deadlines of the control steps, one episode after the other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pace {
    period_s: f64,
    /// Power of two of the speed factor.
    power: i32,
    /// Deadline of the last control step.
    last: Option<Instant>,
}

impl Pace {
    /// Makes deadlines at real time, `period_s` seconds apart.
    pub fn new(period_s: f64) -> Self {
        Self {
            period_s,
            power: 0,
            last: None,
        }
    }

    /// Speed as a factor on real time.
    pub fn speed(self) -> f64 {
        f64::from(self.power).exp2()
    }

    /// Doubles the speed for each `power`, halves it for negative ones, within bounds.
    pub fn change(&mut self, power: i32) {
        self.power = (self.power + power).clamp(SLOWEST, FASTEST);
    }

    fn period(self) -> Duration {
        Duration::from_secs_f64(self.period_s / self.speed())
    }

    /// Deadline of the next control step.
    pub fn due(self, now: Instant) -> Instant {
        match self.last.map(|last| last + self.period()) {
            Some(due) if now < due + self.period() => due,
            _ => now,
        }
    }

    /// Notes that a control step begins that was due at `due`.
    pub fn step(&mut self, due: Instant) {
        self.last = Some(due);
    }

    /// Drops the deadlines, so that the next control step is due at once.
    pub fn rest(&mut self) {
        self.last = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deadlines_are_a_period_apart_however_late_steps_are() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let mut pace = Pace::new(0.080);
        assert_eq!(pace.due(at(5)), at(5), "the first is due at once");
        pace.step(at(5));
        for (now, due) in [(6, 85), (90, 165), (240, 245)] {
            assert_eq!(pace.due(at(now)), at(due));
            pace.step(at(due));
        }
        assert_eq!(pace.due(at(404)), at(325), "within a period it catches up");
        assert_eq!(pace.due(at(406)), at(406), "later it starts anew");
        pace.rest();
        assert_eq!(pace.due(at(300)), at(300));
    }

    #[test]
    fn speed_is_a_power_of_two_within_bounds() {
        let start = Instant::now();
        let mut pace = Pace::new(0.080);
        pace.step(start);
        pace.change(1);
        assert_eq!(pace.speed(), 2.0);
        assert_eq!(pace.due(start), start + Duration::from_millis(40));
        pace.change(-100);
        assert_eq!(pace.speed(), 1.0 / 16.0);
        pace.change(100);
        assert_eq!(pace.speed(), 16.0);
    }
}
