//! Size and power of the verdict: how often a test wrongly reports a difference or equivalence, and how often it rightly does. Rates by
//! summing over all tables, the N-rate by simulation.
//!
//! A reduced one runs with the tests; `cargo test -p lads-proof --release -- --ignored --nocapture size_and_power` prints the table of
//! the crate's README.

mod whole;

use std::collections::HashMap;

use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::Rng as _;

use super::{Counts, EQUIVALENCE_LEVEL, Pairs, exact};

const MARGIN: f64 = 0.05;
const N_MARGIN: f64 = 0.1;
const NUMBERS: [usize; 6] = [25, 50, 100, 200, 500, 1000];

struct Stream(Pcg64Mcg);

impl Stream {
    fn new(seed: u128) -> Self {
        Self(Pcg64Mcg::new(seed * 2 + 1))
    }

    fn unit(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// Model of how one pair of episodes turns out.
#[derive(Clone, Copy)]
enum World {
    /// Loses `loss` of all episodes, among those that the reference does with `p`, and is the same otherwise.
    OneWay { p: f64, loss: f64 },
    /// Loses like `OneWay`, and `swapped` of the pairs differ either way besides.
    TwoWay { p: f64, loss: f64, swapped: f64 },
    /// Draws run and reference as independent samples.
    Apart { p: f64, loss: f64 },
}

impl World {
    fn draw(self, stream: &mut Stream) -> (bool, bool) {
        let u = stream.unit();
        match self {
            Self::OneWay { p, loss } => (u < p - loss, u < p),
            Self::TwoWay { p, loss, swapped } => {
                let half = swapped / 2.0;
                match u {
                    u if u < p - loss - half => (true, true),
                    u if u < p => (false, true),
                    u if u < p + half => (true, false),
                    _ => (false, false),
                }
            }
            Self::Apart { p, loss } => (u < p - loss, stream.unit() < p),
        }
    }

    /// Probabilities of the outcomes "run only" and "reference only".
    fn cells(self) -> [f64; 2] {
        match self {
            Self::OneWay { loss, .. } => [0.0, loss],
            Self::TwoWay { loss, swapped, .. } => [swapped / 2.0, loss + swapped / 2.0],
            Self::Apart { p, loss } => [(p - loss) * (1.0 - p), (1.0 - p + loss) * p],
        }
    }

    fn name(self) -> String {
        match self {
            Self::OneWay { p, .. } => format!("one way, p = {p}"),
            Self::TwoWay { p, swapped, .. } => {
                format!("{:.0} % differ either way, p = {p}", 100.0 * swapped)
            }
            Self::Apart { p, .. } => format!("independent, p = {p}"),
        }
    }
}

fn worlds(loss: f64) -> Vec<World> {
    let mut all = Vec::new();
    for p in [0.5, 0.8, 0.95] {
        all.push(World::OneWay { p, loss });
        all.push(World::TwoWay {
            p,
            loss,
            swapped: 0.04,
        });
        all.push(World::Apart { p, loss });
    }
    all
}

#[derive(Clone, Copy, Default)]
struct Shares {
    equivalent: f64,
    beyond: f64,
}

/// Level at which one of ten tests finds a difference.
const BEYOND_LEVEL: f64 = 1e-3;

/// Regions in which the tests reject, found once for each number of pairs: from the least number of pairs that were done in the run only,
/// for each number done in the reference only. More for the run speaks more for it, so there is one.
#[derive(Default)]
struct Regions(HashMap<(usize, usize, Option<u64>), usize>);

impl Regions {
    /// Returns whether a test rejects: at a level the test of a difference beyond the margin, without one that of a difference inside of it.
    fn rejects(&mut self, b: usize, c: usize, n: usize, beyond: Option<f64>) -> bool {
        let (delta, level) = match beyond {
            Some(level) => (MARGIN, level),
            None => (-MARGIN, EQUIVALENCE_LEVEL),
        };
        let beyond = beyond.map(f64::to_bits);
        let least = self.0.get(&(n, c, beyond)).copied().unwrap_or_else(|| {
            let holds = |b: usize| b > n - c || exact::p_greater(b, c, n, delta) <= level;
            // One more for the reference asks for about one more for the run.
            let beside = c.checked_sub(1).and_then(|c| self.0.get(&(n, c, beyond)));
            let guess = beside.map_or((n - c) / 2, |least| least + 1).min(n - c + 1);
            // `low` is refused or nothing, `high` holds.
            let (mut low, mut high, mut reach) = (0, n - c + 1, 1);
            if holds(guess) {
                high = guess;
                while high > low && holds(high.saturating_sub(reach)) {
                    high = high.saturating_sub(reach);
                    reach *= 2;
                }
                low = high.saturating_sub(reach);
            } else {
                low = guess + 1;
                while !holds(low) {
                    low += reach;
                    reach *= 2;
                }
                (low, high) = (low.saturating_sub(reach), low.min(high));
            }
            while low < high {
                let middle = usize::midpoint(low, high);
                if holds(middle) {
                    high = middle;
                } else {
                    low = middle + 1;
                }
            }
            self.0.insert((n, c, beyond), low);
            low
        });
        b >= least
    }

    fn judge(&mut self, pairs: &Pairs) -> (bool, bool) {
        let (b, c, n) = (pairs.run_only, pairs.reference_only, pairs.len());
        let equivalent = self.rejects(b, c, n, None) && self.rejects(c, b, n, None);
        (
            equivalent,
            self.rejects(b, c, n, Some(BEYOND_LEVEL)) || self.rejects(c, b, n, Some(BEYOND_LEVEL)),
        )
    }
}

/// Estimates how often verifications of `n` pairs say EQUIVALENT, and DIFFERENT at the level of one of ten tests, from `trials` of them.
fn rates(regions: &mut Regions, world: World, n: usize, trials: usize, seed: u128) -> Shares {
    let mut stream = Stream::new(seed);
    let mut shares = Shares::default();
    for _ in 0..trials {
        let mut pairs = Pairs::default();
        for _ in 0..n {
            let (run, reference) = world.draw(&mut stream);
            pairs.add(run, reference);
        }
        let (equivalent, beyond) = regions.judge(&pairs);
        shares.equivalent += f64::from(u8::from(equivalent)) / trials as f64;
        shares.beyond += f64::from(u8::from(beyond)) / trials as f64;
    }
    shares
}

/// Computes the same shares as [`rates`] exactly: the sum over all tables that pairs of a world can give.
fn exactly(regions: &mut Regions, world: World, n: usize) -> Shares {
    let [run_only, reference_only] = world.cells();
    let mut shares = Shares::default();
    let near = |mean: f64, most: usize| {
        let reach = 8.0 * mean.sqrt() + 8.0;
        (
            (mean - reach).max(0.0) as usize,
            ((mean + reach) as usize).min(most),
        )
    };
    let (from, to) = near(n as f64 * reference_only, n);
    for c in from..=to {
        let chance_of_c = exact::likelihood(c, n, reference_only);
        let share = run_only / (1.0 - reference_only);
        let (from, to) = near((n - c) as f64 * share, n - c);
        for b in from..=to {
            let chance = chance_of_c * exact::likelihood(b, n - c, share);
            if chance < 1e-12 {
                continue;
            }
            let pairs = Pairs {
                both: n - b - c,
                run_only: b,
                reference_only: c,
                neither: 0,
            };
            let (equivalent, beyond) = regions.judge(&pairs);
            shares.equivalent += chance * f64::from(u8::from(equivalent));
            shares.beyond += chance * f64::from(u8::from(beyond));
        }
    }
    shares
}

#[test]
fn simulation_and_sum_agree() {
    let mut regions = Regions::default();
    for world in worlds(0.02) {
        let [drawn, summed] = [
            rates(&mut regions, world, 100, 2000, 5).equivalent,
            exactly(&mut regions, world, 100).equivalent,
        ];
        assert!(
            (drawn - summed).abs() < 0.045,
            "{}: {drawn} {summed}",
            world.name()
        );
    }
}

#[test]
fn the_regions_are_those_of_the_verdict() {
    let mut regions = Regions::default();
    for (b, c) in [(0, 0), (3, 0), (0, 3), (5, 4), (2, 9), (30, 1)] {
        let pairs = Pairs {
            both: 100 - b - c,
            run_only: b,
            reference_only: c,
            neither: 0,
        };
        let paired = pairs.paired(MARGIN);
        assert_eq!(
            regions.judge(&pairs),
            (paired.equivalent, paired.beyond_margin(BEYOND_LEVEL)),
            "{b} {c}"
        );
    }
}

/// Losses of the N-rate: all four sub-tasks in few episodes, or one in many; with the share of other pairs that differ either way.
const N_WORLDS: [(&str, usize, f64); 3] = [
    ("all of the loss in few episodes", 4, 0.0),
    ("one sub-task in many", 1, 0.0),
    ("one in many, 20 % differ either way", 1, 0.2),
];

fn n_rates(
    (_, lost, swapped): (&str, usize, f64),
    loss: f64,
    n: usize,
    trials: usize,
    seed: u128,
) -> Shares {
    let mut stream = Stream::new(seed);
    let mut shares = Shares::default();
    for _ in 0..trials {
        let mut counts = Counts::default();
        for _ in 0..n {
            let [u, v] = [stream.unit(), stream.unit()];
            let (run, reference) = match v {
                v if v < swapped / 2.0 => (3, 2),
                v if v < swapped => (2, 3),
                _ => (4, 4),
            };
            let drop = if u < loss / lost as f64 { lost } else { 0 };
            counts.add(run.max(drop) - drop, reference, 4);
        }
        let difference = counts.judged(N_MARGIN);
        shares.equivalent += f64::from(u8::from(difference.0 <= EQUIVALENCE_LEVEL)) / trials as f64;
        shares.beyond += f64::from(u8::from(difference.1 < BEYOND_LEVEL)) / trials as f64;
    }
    shares
}

/// Chance excess of a share of `trials` over its bound: three standard errors.
fn slack(bound: f64, trials: usize) -> f64 {
    3.0 * (bound * (1.0 - bound) / trials as f64).sqrt()
}

#[test]
fn a_true_difference_at_the_margin_is_seldom_equivalent() {
    let (trials, mut regions) = (400, Regions::default());
    for world in worlds(MARGIN) {
        for n in [25, 50, 100, 200] {
            let found = exactly(&mut regions, world, n).equivalent;
            assert!(found <= 0.05, "{} n {n}: {found}", world.name());
        }
    }
    for (place, world) in N_WORLDS.into_iter().enumerate() {
        for n in NUMBERS {
            let found = n_rates(world, N_MARGIN, n, trials, 7 + place as u128).equivalent;
            assert!(
                found <= 0.05 + slack(0.05, trials),
                "{} n {n}: {found}",
                world.0
            );
        }
    }
}

#[test]
fn two_samples_of_one_policy_are_seldom_different() {
    let mut regions = Regions::default();
    for p in [0.5, 0.8, 0.95] {
        for n in [25, 100] {
            let found = exactly(&mut regions, World::Apart { p, loss: 0.0 }, n).beyond;
            // One of ten tests.
            assert!(10.0 * found <= 0.01, "p {p} n {n}: {found}");
        }
    }
}

#[test]
fn the_same_policy_is_equivalent_where_there_are_enough_pairs() {
    let mut regions = Regions::default();
    let same = World::OneWay { p: 0.8, loss: 0.0 };
    assert!(exactly(&mut regions, same, 100).equivalent > 1.0 - 1e-9);
    let rounding = World::TwoWay {
        p: 0.8,
        loss: 0.0,
        swapped: 0.02,
    };
    assert!(exactly(&mut regions, rounding, 500).equivalent > 0.99);
}

/// Prints the tables of README.md and holds their sizes to the bounds, with as many pairs as the smaller tests have no time for.
#[test]
#[ignore = "minutes; prints the tables of README.md"]
fn size_and_power() {
    let (trials, mut regions) = (4000, Regions::default());
    let heading = format!("| | {} |", NUMBERS.map(|n| n.to_string()).join(" | "));
    let rule = "|---|---|---|---|---|---|---|";
    for (title, loss) in [
        (
            "EQUIVALENT in % though the run loses 5 % (size: at most 5)",
            MARGIN,
        ),
        ("EQUIVALENT in % where there is no loss (power)", 0.0),
        ("EQUIVALENT in % where the loss is 1 % (power)", 0.01),
    ] {
        println!("\n{title}\n\n{heading}\n{rule}");
        for world in worlds(loss) {
            let found = NUMBERS.map(|n| exactly(&mut regions, world, n).equivalent);
            let row = found.map(|found| format!("{:.1}", 100.0 * found));
            println!("| {} | {} |", world.name(), row.join(" | "));
            let bounded = loss < MARGIN || found.iter().all(|&found| found <= 0.05);
            assert!(bounded, "{}: {found:?}", world.name());
        }
    }
    println!("\nDIFFERENT in % by one rate of ten\n\n{heading}\n{rule}");
    for loss in [0.0, 0.1, 0.2, 0.4] {
        let world = World::Apart { p: 0.8, loss };
        let found = NUMBERS.map(|n| exactly(&mut regions, world, n).beyond);
        let row = found.map(|found| format!("{:.2}", 100.0 * found));
        println!(
            "| independent, p = 0.8, loss {loss} | {} |",
            row.join(" | ")
        );
        let bounded = loss > 0.0 || found.iter().all(|&found| 10.0 * found <= 0.01);
        assert!(bounded, "{found:?}");
    }
    for (title, loss) in [
        ("though it is 0.1 (size: at most 5)", N_MARGIN),
        ("where there is none (power)", 0.0),
    ] {
        println!("\nN-rate: EQUIVALENT in % by loss {title}\n\n{heading}\n{rule}");
        for world in N_WORLDS {
            let found = NUMBERS.map(|n| n_rates(world, loss, n, trials, 13).equivalent);
            let row = found.map(|found| format!("{:.1}", 100.0 * found));
            println!("| {} | {} |", world.0, row.join(" | "));
            let bound = 0.05 + slack(0.05, trials);
            let bounded = loss < N_MARGIN || found.iter().all(|&found| found <= bound);
            assert!(bounded, "{}: {found:?}", world.0);
        }
    }
}
