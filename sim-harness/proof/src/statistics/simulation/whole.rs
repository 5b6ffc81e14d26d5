//! The verdict as a whole, of the policies that ship: how often a verification says EQUIVALENT though one thing is lost, and DIFFERENT of two
//! samples of one policy.
//!
//! Episodes are drawn from those that a shipped reference recorded, instruction by instruction, so that rates, and how many pairs each
//! sub-task has, are those of its verification. A reduced one runs with the tests;
//! `cargo test -p lads-proof --release -- --ignored --nocapture whole_verdict` prints the tables of the crate's README.

use std::io::Write as _;
use std::path::Path;

use serde_json::Value;

use super::super::{Counts, EQUIVALENCE_LEVEL, Pairs};
use super::{NUMBERS, Regions, Stream, slack};
use crate::certificate::DIFFERENCE;
use crate::pairs::{N_RATE_MARGIN, RATE_MARGIN};

/// Outcome of one episode: which of the commanded sub-tasks were done, a bit for each in their order, and whether that counts as success.
#[derive(Clone, Copy, PartialEq)]
struct Outcome {
    done: u32,
    success: bool,
}

impl Outcome {
    fn did(self, place: usize) -> bool {
        self.done >> place & 1 == 1
    }
}

struct Instruction {
    /// Indices into the names of sub-tasks.
    commanded: Vec<usize>,
    episodes: Vec<Outcome>,
}

/// Reference of a shipped policy.
struct Shipped {
    sub_tasks: Vec<String>,
    instructions: Vec<Instruction>,
    /// Number of pairs of a whole verification.
    all: usize,
}

/// Loss that the simulated policy has against the reference's.
#[derive(Clone, Copy, PartialEq)]
enum Lost {
    /// No loss: run and reference are samples of one policy.
    Nothing,
    /// Loss of a rate by its margin; the last rate is full success.
    Rate(usize),
    /// Loss of the N-rate by its margin: a sub-task in each of many episodes.
    Completions,
}

/// Relation of the run's episodes to the reference's, besides the loss.
#[derive(Clone, Copy)]
enum Beside {
    /// The episodes are the same.
    Same,
    /// Four of a hundred episodes are drawn anew.
    Few,
    /// All episodes are drawn anew.
    All,
}

/// Share of the episodes that [`Beside::Few`] draws anew.
const FEW: f64 = 0.04;

/// Number of verifications that estimate the share of the worst loss, drawn anew: the largest share of a dozen is also the luckiest.
const ANEW: usize = 20_000;

impl Shipped {
    fn open(name: &str) -> Self {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models");
        let text = std::fs::read(path.join(format!("{name}.reference.json"))).unwrap();
        let found: Value = serde_json::from_slice(&text).unwrap();
        let list = |value: &Value, key: &str| value[key].as_array().unwrap().clone();
        let mut sub_tasks: Vec<String> = Vec::new();
        let mut instructions = Vec::new();
        for row in list(&found, "instructions") {
            let names = list(&row, "sub_tasks");
            let commanded = names.iter().map(|name| {
                let name = name.as_str().unwrap();
                let place = sub_tasks.iter().position(|known| known == name);
                place.unwrap_or_else(|| {
                    sub_tasks.push(name.to_owned());
                    sub_tasks.len() - 1
                })
            });
            let commanded: Vec<usize> = commanded.collect();
            let episodes = list(&row, "episodes");
            let outcome = |episode: &Value| {
                let completed = list(episode, "completions");
                let is_done = |name: &Value| completed.iter().any(|one| one["sub_task"] == *name);
                Outcome {
                    done: (0..)
                        .zip(&names)
                        .map(|(place, name)| u32::from(is_done(name)) << place)
                        .sum(),
                    success: episode["success"].as_bool().unwrap(),
                }
            };
            instructions.push(Instruction {
                commanded,
                episodes: episodes.iter().map(outcome).collect(),
            });
        }
        let all = instructions.iter().map(|row| row.episodes.len()).sum();
        Self {
            sub_tasks,
            instructions,
            all,
        }
    }

    /// The instruction of each of `n` pairs: all alike often, in an order that spreads them.
    fn order(&self, n: usize) -> impl Iterator<Item = &Instruction> {
        let len = self.instructions.len();
        let stride = (1..len)
            .rev()
            .find(|&by| gcd(by, len) == 1 && by * 13 < len * 8);
        let stride = stride.unwrap_or(1);
        (0..n).map(move |i| &self.instructions[i * stride % len])
    }

    /// Rates, in order, of those `n` pairs: how many of these there are, and how many the reference succeeds in on the mean.
    fn rates(&self, n: usize) -> Vec<[f64; 2]> {
        let mut rates = vec![[0.0; 2]; self.sub_tasks.len() + 1];
        for row in self.order(n) {
            let episodes = row.episodes.len() as f64;
            let share = |is: &dyn Fn(&Outcome) -> bool| {
                row.episodes.iter().filter(|episode| is(episode)).count() as f64 / episodes
            };
            for (place, &index) in row.commanded.iter().enumerate() {
                rates[index][0] += 1.0;
                rates[index][1] += share(&|episode| episode.did(place));
            }
            let full = rates.len() - 1;
            rates[full][0] += 1.0;
            rates[full][1] += share(&|episode| episode.success);
        }
        rates
    }

    /// Share of the episodes in which something is to be lost that can be, so that as much is lost as the margin says; `None` where there
    /// is less.
    fn share(&self, lost: Lost, n: usize) -> Option<f64> {
        let rates = self.rates(n);
        let share = match lost {
            Lost::Nothing => return Some(0.0),
            Lost::Rate(rate) => {
                let [pairs, done] = *rates.get(rate)?;
                RATE_MARGIN * pairs / done
            }
            Lost::Completions => {
                let with = self.order(n).map(|row| {
                    let some = row.episodes.iter().filter(|one| one.done != 0);
                    some.count() as f64 / row.episodes.len() as f64
                });
                N_RATE_MARGIN * n as f64 / with.sum::<f64>()
            }
        };
        (share <= 1.0).then_some(share)
    }

    /// Whether one verification of `n` pairs says EQUIVALENT, and whether it says DIFFERENT.
    fn verify(
        &self,
        regions: &mut Regions,
        (lost, share, beside): (Lost, f64, Beside),
        n: usize,
        stream: &mut Stream,
    ) -> [bool; 2] {
        let full = self.sub_tasks.len();
        let mut pairs = vec![Pairs::default(); full + 1];
        let mut counts = Counts::default();
        for row in self.order(n) {
            let mut draw = || {
                let place = (stream.unit() * row.episodes.len() as f64) as usize;
                row.episodes[place]
            };
            let reference = draw();
            let anew = draw();
            let mut run = match beside {
                Beside::Few if stream.unit() < FEW => anew,
                Beside::Same | Beside::Few => reference,
                Beside::All => anew,
            };
            if stream.unit() < share {
                lose(&mut run, lost, &row.commanded, full);
            }
            for (place, &index) in row.commanded.iter().enumerate() {
                pairs[index].add(run.did(place), reference.did(place));
            }
            pairs[full].add(run.success, reference.success);
            let [ours, theirs] = [run, reference].map(|one| one.done.count_ones() as usize);
            counts.add(ours, theirs, row.commanded.len());
        }
        let present: Vec<_> = pairs.iter().filter(|pairs| !pairs.is_empty()).collect();
        let level = DIFFERENCE / (present.len() + 1) as f64;
        let (equal, apart) = counts.judged(N_RATE_MARGIN);
        let mut equivalent = equal <= EQUIVALENCE_LEVEL;
        let mut different = apart < level;
        for pairs in present {
            let (b, c, n) = (pairs.run_only, pairs.reference_only, pairs.len());
            different |= [(b, c), (c, b)]
                .into_iter()
                .any(|(more, less)| regions.rejects(more, less, n, Some(level)));
            equivalent = equivalent
                && [(b, c), (c, b)]
                    .into_iter()
                    .all(|(more, less)| regions.rejects(more, less, n, None));
        }
        [equivalent && !different, different]
    }

    /// Computes the shares of many verifications that find equivalence and difference.
    fn shares(
        &self,
        regions: &mut Regions,
        (lost, beside): (Lost, Beside),
        n: usize,
        (trials, seed): (usize, u128),
    ) -> Option<[f64; 2]> {
        let share = self.share(lost, n)?;
        let mut stream = Stream::new(seed);
        let mut sums = [0.0; 2];
        for _ in 0..trials {
            let said = self.verify(regions, (lost, share, beside), n, &mut stream);
            for (sum, said) in sums.iter_mut().zip(said) {
                *sum += f64::from(u8::from(said)) / trials as f64;
            }
        }
        Some(sums)
    }

    /// What is lost with the largest share of EQUIVALENT, and that share.
    fn most_equivalent(
        &self,
        regions: &mut Regions,
        beside: Beside,
        n: usize,
        drawn: (usize, u128),
    ) -> (Lost, f64) {
        let rates = (0..=self.sub_tasks.len()).map(Lost::Rate);
        rates
            .chain([Lost::Completions])
            .filter_map(|lost| Some((lost, self.shares(regions, (lost, beside), n, drawn)?[0])))
            .max_by(|(_, a), (_, b)| a.total_cmp(b))
            .unwrap()
    }

    /// Chance that the tests of the rate that is lost find it equivalent, which the whole verdict's cannot exceed: the sum over all tables,
    /// with the chances of each instruction's pairs. `None` where there is less to lose.
    fn passes(
        &self,
        regions: &mut Regions,
        (rate, beside): (usize, Beside),
        n: usize,
    ) -> Option<f64> {
        let share = self.share(Lost::Rate(rate), n)?;
        let anew = match beside {
            Beside::Same => 0.0,
            Beside::Few => FEW,
            Beside::All => 1.0,
        };
        let full = self.sub_tasks.len();
        let cells = self.order(n).filter_map(|row| {
            let place = row.commanded.iter().position(|&index| index == rate);
            let is = |one: &&Outcome| match place {
                Some(place) => one.did(place),
                None => one.success,
            };
            let done = row.episodes.iter().filter(is).count() as f64 / row.episodes.len() as f64;
            let kept = done * (1.0 - share);
            let lost_and_gained = [
                anew * (1.0 - done) * kept,
                done * ((1.0 - anew) * share + anew * (1.0 - kept)),
            ];
            (place.is_some() || rate == full).then_some(lost_and_gained)
        });
        let cells: Vec<[f64; 2]> = cells.collect();
        let pairs = cells.len();
        let most = [0, 1].map(|at| {
            let mean: f64 = cells.iter().map(|cell| cell[at]).sum();
            ((mean + 8.0 * mean.sqrt() + 8.0) as usize).min(pairs)
        });
        let mut passed = 0.0;
        for (at, chance) in tables(&cells, most).into_iter().enumerate() {
            let (b, c) = (at / (most[1] + 1), at % (most[1] + 1));
            if chance > 1e-12
                && b + c <= pairs
                && regions.rejects(b, c, pairs, None)
                && regions.rejects(c, b, pairs, None)
            {
                passed += chance;
            }
        }
        Some(passed)
    }

    /// The largest of [`passes`](Self::passes) over the rates.
    fn most_passes(&self, regions: &mut Regions, beside: Beside, n: usize) -> f64 {
        (0..=self.sub_tasks.len())
            .filter_map(|rate| self.passes(regions, (rate, beside), n))
            .fold(0.0, f64::max)
    }
}

/// Chances of the tables of pairs with these chances of "run only" and "reference only", up to the largest counts of both: row by row,
/// those of one count of "run only" side by side.
fn tables(cells: &[[f64; 2]], most: [usize; 2]) -> Vec<f64> {
    let width = most[1] + 1;
    let mut chances = vec![0.0; (most[0] + 1) * width];
    chances[0] = 1.0;
    for (added, &[run_only, reference_only]) in (1..).zip(cells) {
        let same = 1.0 - run_only - reference_only;
        // From the last: each reads what has not been written yet.
        for b in (0..=most[0].min(added)).rev() {
            for c in (0..=most[1].min(added - b)).rev() {
                let at = b * width + c;
                let mut chance = same * chances[at];
                if b > 0 {
                    chance += run_only * chances[at - width];
                }
                if c > 0 {
                    chance += reference_only * chances[at - 1];
                }
                chances[at] = chance;
            }
        }
    }
    chances
}

/// Takes from an episode what is lost; where that is a sub-task, its success too.
fn lose(run: &mut Outcome, lost: Lost, commanded: &[usize], full: usize) {
    let place = match lost {
        Lost::Nothing => None,
        Lost::Rate(rate) if rate == full => {
            run.success = false;
            None
        }
        Lost::Rate(rate) => commanded.iter().position(|&index| index == rate),
        Lost::Completions => (run.done != 0).then(|| run.done.trailing_zeros() as usize),
    };
    if let Some(place) = place
        && run.did(place)
    {
        run.done &= !(1 << place);
        run.success = false;
    }
}

fn gcd(a: usize, b: usize) -> usize {
    if b == 0 { a } else { gcd(b, a % b) }
}

#[test]
fn the_verdict_of_what_ships_holds_its_level() {
    let trials = 120;
    for name in ["kitchen", "lorel"] {
        let (shipped, mut regions) = (Shipped::open(name), Regions::default());
        // Shares are what they say: the margin is lost, in the mean.
        let rates = shipped.rates(shipped.all);
        let full = rates.len() - 1;
        let share = shipped.share(Lost::Rate(full), shipped.all).unwrap();
        assert!((share * rates[full][1] / rates[full][0] - RATE_MARGIN).abs() < 1e-9);
        for n in [100, 500] {
            let drawn = (trials, 17);
            let (_, wrong) = shipped.most_equivalent(&mut regions, Beside::Same, n, drawn);
            assert!(wrong <= 0.05 + slack(0.05, trials), "{name}, {n}: {wrong}");
            let alike = (Lost::Nothing, Beside::All);
            let [_, different] = shipped.shares(&mut regions, alike, n, drawn).unwrap();
            assert!(
                different <= 0.01 + slack(0.01, trials),
                "{name}, {n}: {different}"
            );
        }
    }
    // There are enough pairs in a verification to say so of the same policy.
    let (shipped, mut regions) = (Shipped::open("kitchen"), Regions::default());
    let same = (Lost::Nothing, Beside::Same);
    let [equivalent, _] = shipped
        .shares(&mut regions, same, shipped.all, (2, 17))
        .unwrap();
    assert_eq!(equivalent, 1.0);
}

/// Tests the exact sum against simulated verifications, and that no rate's test passes too often, at every number of pairs.
#[test]
fn the_test_of_a_lost_rate_holds_its_level_over_unlike_instructions() {
    let (shipped, mut regions) = (Shipped::open("kitchen"), Regions::default());
    for beside in [Beside::Same, Beside::Few, Beside::All] {
        for n in [25, 50, 100, 200] {
            let most = shipped.most_passes(&mut regions, beside, n);
            assert!(most <= 0.05, "{n}: {most}");
        }
    }
    // Full success alone: nothing else is lost with it, so the other tests pass where all pairs are the same otherwise.
    let (full, n, trials) = (shipped.sub_tasks.len(), 200, 2000);
    let lost = (Lost::Rate(full), Beside::Same);
    let [simulated, _] = shipped.shares(&mut regions, lost, n, (trials, 19)).unwrap();
    let summed = shipped
        .passes(&mut regions, (full, Beside::Same), n)
        .unwrap();
    assert!(
        (simulated - summed).abs() <= slack(0.05, trials),
        "{simulated} {summed}"
    );
}

/// Prints a table of README.md, cell by cell.
fn table(name: &str) {
    let (shipped, mut regions) = (Shipped::open(name), Regions::default());
    // Thousands of pairs take long, one by one.
    let trials = |n: usize| (if n > 1000 { 400 } else { 2000 }, 17);
    let numbers: Vec<usize> = NUMBERS.into_iter().chain([shipped.all]).collect();
    let heading = numbers.iter().map(|n| format!(" {n} |"));
    println!(
        "\n| {name}, {} rates |{}\n|---|{}",
        shipped.sub_tasks.len() + 1,
        heading.collect::<String>(),
        "---|".repeat(numbers.len())
    );
    let row =
        |title: &str, (beside, digits): (Beside, usize), cell: &mut dyn FnMut(usize) -> f64| {
            print!("| {title} |");
            for &n in &numbers {
                // Where thousands of pairs are independent, as no verification's are, the regions alone take hours.
                if n > 1000 && matches!(beside, Beside::All) {
                    print!(" - |");
                } else {
                    print!(" {:.digits$} |", 100.0 * cell(n));
                }
                std::io::stdout().flush().unwrap();
            }
            println!();
        };
    let alike = (Lost::Nothing, Beside::All);
    row(
        "DIFFERENT, two samples of one policy",
        (alike.1, 1),
        &mut |n| shipped.shares(&mut regions, alike, n, trials(n)).unwrap()[1],
    );
    for (title, beside) in [
        (
            "EQUIVALENT, nothing lost, the same in every pair",
            Beside::Same,
        ),
        ("EQUIVALENT, nothing lost, 4 % drawn anew", Beside::Few),
    ] {
        row(title, (beside, 1), &mut |n| {
            shipped
                .shares(&mut regions, (Lost::Nothing, beside), n, trials(n))
                .unwrap()[0]
        });
    }
    for (title, beside) in [
        ("EQUIVALENT though one thing is lost, one way", Beside::Same),
        ("the same, 4 % drawn anew besides", Beside::Few),
        ("the same, all drawn anew", Beside::All),
    ] {
        row(title, (beside, 1), &mut |n| {
            let (lost, _) = shipped.most_equivalent(&mut regions, beside, n, trials(n));
            let alone = (lost, beside);
            shipped.shares(&mut regions, alone, n, (ANEW, 18)).unwrap()[0]
        });
        let title = "at most: a lost rate's own test, summed exactly";
        row(title, (beside, 2), &mut |n| {
            let most = shipped.most_passes(&mut regions, beside, n);
            assert!(most <= EQUIVALENCE_LEVEL, "{n}: {most}");
            most
        });
    }
}

#[test]
#[ignore = "minutes; prints a table of README.md"]
fn whole_verdict_of_kitchen() {
    table("kitchen");
}

#[test]
#[ignore = "minutes; prints a table of README.md"]
fn whole_verdict_of_lorel() {
    table("lorel");
}
