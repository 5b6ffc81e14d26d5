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
                Beside::Few if stream.unit() < 0.04 => anew,
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
        trials: usize,
    ) -> Option<[f64; 2]> {
        let share = self.share(lost, n)?;
        let mut stream = Stream::new(17);
        let mut sums = [0.0; 2];
        for _ in 0..trials {
            let said = self.verify(regions, (lost, share, beside), n, &mut stream);
            for (sum, said) in sums.iter_mut().zip(said) {
                *sum += f64::from(u8::from(said)) / trials as f64;
            }
        }
        Some(sums)
    }

    /// The largest share of EQUIVALENT among what can be lost.
    fn most_equivalent(
        &self,
        regions: &mut Regions,
        beside: Beside,
        n: usize,
        trials: usize,
    ) -> f64 {
        let rates = (0..=self.sub_tasks.len()).map(Lost::Rate);
        rates
            .chain([Lost::Completions])
            .filter_map(|lost| self.shares(regions, (lost, beside), n, trials))
            .map(|[equivalent, _]| equivalent)
            .fold(0.0, f64::max)
    }
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
            let wrong = shipped.most_equivalent(&mut regions, Beside::Same, n, trials);
            assert!(wrong <= 0.05 + slack(0.05, trials), "{name}, {n}: {wrong}");
            let alike = (Lost::Nothing, Beside::All);
            let [_, different] = shipped.shares(&mut regions, alike, n, trials).unwrap();
            assert!(
                different <= 0.01 + slack(0.01, trials),
                "{name}, {n}: {different}"
            );
        }
    }
    // There are enough pairs in a verification to say so of the same policy.
    let (shipped, mut regions) = (Shipped::open("kitchen"), Regions::default());
    let same = (Lost::Nothing, Beside::Same);
    let [equivalent, _] = shipped.shares(&mut regions, same, shipped.all, 2).unwrap();
    assert_eq!(equivalent, 1.0);
}

/// Prints a table of README.md, cell by cell.
fn table(name: &str) {
    let (shipped, mut regions) = (Shipped::open(name), Regions::default());
    // Thousands of pairs take long, one by one.
    let trials = |n: usize| if n > 1000 { 400 } else { 2000 };
    let numbers: Vec<usize> = NUMBERS.into_iter().chain([shipped.all]).collect();
    let heading = numbers.iter().map(|n| format!(" {n} |"));
    println!(
        "\n| {name}, {} rates |{}\n|---|{}",
        shipped.sub_tasks.len() + 1,
        heading.collect::<String>(),
        "---|".repeat(numbers.len())
    );
    let row = |title: &str, beside: Beside, cell: &mut dyn FnMut(usize) -> f64| {
        print!("| {title} |");
        for &n in &numbers {
            // Where thousands of pairs are independent, as no verification's are, the regions alone take hours.
            if n > 1000 && matches!(beside, Beside::All) {
                print!(" - |");
            } else {
                print!(" {:.1} |", 100.0 * cell(n));
            }
            std::io::stdout().flush().unwrap();
        }
        println!();
    };
    let alike = (Lost::Nothing, Beside::All);
    row("DIFFERENT, two samples of one policy", alike.1, &mut |n| {
        shipped.shares(&mut regions, alike, n, trials(n)).unwrap()[1]
    });
    for (title, beside) in [
        (
            "EQUIVALENT, nothing lost, the same in every pair",
            Beside::Same,
        ),
        ("EQUIVALENT, nothing lost, 4 % drawn anew", Beside::Few),
    ] {
        row(title, beside, &mut |n| {
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
        row(title, beside, &mut |n| {
            shipped.most_equivalent(&mut regions, beside, n, trials(n))
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
