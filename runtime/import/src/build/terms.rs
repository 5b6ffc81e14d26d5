//! Builds terms from nodes: raw values of one or several steps, processed, and laid out as the
//! graph reads them.
//!
//! A history that begins with its first step is a ring of raw values; one that begins with zeros is
//! a state of processed values, because training puts its zeros after the processing. The last
//! action, whose first value is zero, is a state in either case.

use std::collections::HashMap;

use super::{Kept, Net, entry};
use crate::plan::{Bounds, Feed, Plan, Source, Stack, Term};
use crate::robot::{Layout, Order, Start, Wave};

/// Name of the state that holds the last action.
const LAST_ACTION: &str = "last.action";
const CLOCK: &str = "gait.clock";
const STEPS: &str = "episode.steps";

/// Rings and processed values that several terms share.
pub(super) struct Pieces<'p> {
    plan: &'p Plan,
    /// Number of rows of each channel's ring, for the rings that are inputs already.
    rings: HashMap<usize, usize>,
    /// Processing of the columns of each channel, if all terms agree on it.
    whole: Vec<Option<Whole>>,
    /// Names of processed values, by the names of the raw ones.
    done: HashMap<String, String>,
    last_action: bool,
    /// Angle by which the clock turns in a step.
    clock: Option<f64>,
    steps: bool,
    histories: usize,
}

/// Offset, clip and scale of every column of a channel: one operation for the channel instead of
/// one for each term.
struct Whole {
    offset: Vec<f64>,
    clip: Bounds,
    scale: Vec<f64>,
}

impl Whole {
    /// Returns the common processing of a channel's columns; `None` if two terms read a column
    /// differently.
    fn of(plan: &Plan, wanted: usize) -> Option<Self> {
        let mut columns: Vec<Option<[f64; 4]>> = vec![None; plan.channels[wanted].elements.len()];
        for (_, feed) in &plan.feeds {
            let Feed::Terms { terms, .. } = feed else {
                continue;
            };
            for term in terms {
                let Source::Columns {
                    channel,
                    columns: own,
                } = &term.source
                else {
                    continue;
                };
                for (i, &column) in own.iter().enumerate().filter(|_| *channel == wanted) {
                    let (low, high) = match &term.clip {
                        Some((low, high)) => (low[i], high[i]),
                        None => UNBOUNDED,
                    };
                    let row = [term.offset[i], low, high, term.scale[i]];
                    if columns[column].is_some_and(|known| known != row) {
                        return None;
                    }
                    columns[column] = Some(row);
                }
            }
        }
        // Of an orientation's columns nothing but gravity is read.
        let of = |part: usize| {
            let neutral = [0.0, UNBOUNDED.0, UNBOUNDED.1, 1.0];
            columns
                .iter()
                .map(|row| row.unwrap_or(neutral)[part])
                .collect()
        };
        Some(Self {
            offset: of(0),
            clip: (of(1), of(2)),
            scale: of(3),
        })
    }

    fn process(&self, net: &mut Net, raw: String) -> String {
        let value = net.moved("Sub", raw, &self.offset);
        let (low, high) = &self.clip;
        let bounded = low.iter().any(|&low| low != UNBOUNDED.0)
            || high.iter().any(|&high| high != UNBOUNDED.1);
        let value = net.clipped(value, bounded.then_some(&self.clip));
        net.scaled(value, &self.scale)
    }
}

/// Bounds of a column that is not clipped.
const UNBOUNDED: (f64, f64) = (f32::MIN as f64, f32::MAX as f64);

/// Returns the files whose outputs an input is made of.
pub(super) fn outputs(feed: &Feed) -> Vec<usize> {
    match feed {
        Feed::Wire(edge) => vec![edge.file],
        Feed::Terms { terms, .. } => {
            let output = |term: &Term| match &term.source {
                Source::Output(edge) => Some(edge.file),
                _ => None,
            };
            terms.iter().filter_map(output).collect()
        }
        _ => vec![],
    }
}

impl<'p> Pieces<'p> {
    pub fn new(plan: &'p Plan) -> Self {
        Self {
            plan,
            rings: HashMap::new(),
            whole: (0..plan.channels.len())
                .map(|channel| Whole::of(plan, channel))
                .collect(),
            done: HashMap::new(),
            last_action: false,
            clock: None,
            steps: false,
            histories: 0,
        }
    }

    /// Builds an input of a graph, `[1, n]`.
    pub fn input(&mut self, net: &mut Net, terms: &[Term], stack: Stack) -> String {
        let mut parts = vec![];
        for term in terms {
            let rows = self.rows(net, term, stack.start);
            parts.push(match stack.order {
                Order::NewestFirst if term.history > 1 => {
                    let back: Vec<i64> = (0..term.history as i64).rev().collect();
                    net.gathered(&rows, &back, 0)
                }
                _ => rows,
            });
        }
        let steps = terms.iter().map(|term| term.history).max().unwrap_or(1);
        let width: usize = terms.iter().map(Term::width).sum();
        match stack.layout {
            _ if steps == 1 => net.joined(&parts, 1),
            Layout::Term => {
                let flat: Vec<String> = (parts.iter().zip(terms))
                    .map(|(part, term)| net.shaped(part, &[1, term.history * term.width()]))
                    .collect();
                net.joined(&flat, 1)
            }
            Layout::Time => {
                let all = net.joined(&parts, 1);
                net.shaped(&all, &[1, steps * width])
            }
            Layout::Element => {
                let all = net.joined(&parts, 1);
                let turned = net.turned(&all);
                net.shaped(&turned, &[1, steps * width])
            }
        }
    }

    /// Builds the processed values of a term, `[history, width]`, the oldest first.
    fn rows(&mut self, net: &mut Net, term: &Term, start: Start) -> String {
        let channel = match &term.source {
            Source::Columns { channel, .. } | Source::Gravity { channel, .. } => Some(*channel),
            _ => None,
        };
        if let (Some(channel), Start::First, true) = (channel, start, term.history > 1) {
            let raw = self.ring(net, channel, term.history);
            return self.processed(net, channel, term, raw);
        }
        let now = if let Some(channel) = channel {
            let raw = entry(&self.plan.channels[channel].name);
            self.processed(net, channel, term, raw)
        } else {
            let raw = self.own(net, term).unwrap_or_default();
            finished(net, term, raw)
        };
        if term.history == 1 {
            return now;
        }
        let (name, width) = (format!("history.{}", self.histories), term.width());
        self.histories += 1;
        let before = [term.history - 1, width];
        net.input(&name, &before);
        net.kept.push(Kept::plain(&name, &before));
        let known = entry(&name);
        let all = net.joined(&[known, now], 0);
        let later: Vec<i64> = (1..term.history as i64).collect();
        let later = net.gathered(&all, &later, 0);
        net.output(&format!("next_{name}"), &later, &before);
        all
    }

    /// Builds the last rows of a channel. The ring has as many rows as the longest history of the
    /// channel.
    fn ring(&mut self, net: &mut Net, channel: usize, history: usize) -> String {
        let found = &self.plan.channels[channel];
        let name = format!("ring.{}", found.name);
        let width = found.elements.len();
        let rows = *self.rings.entry(channel).or_insert_with(|| {
            let longest = longest(self.plan, channel);
            net.input(&name, &[longest, width]);
            net.kept.push(Kept::Ring {
                name: name.clone(),
                rows: longest,
                source: found.name.clone(),
            });
            longest
        });
        let value = entry(&name);
        if rows == history {
            return value;
        }
        let last: Vec<i64> = ((rows - history) as i64..rows as i64).collect();
        net.gathered(&value, &last, 0)
    }

    /// Computes `clip(raw - offset) * scale` of a term's columns of a channel's rows.
    fn processed(&mut self, net: &mut Net, channel: usize, term: &Term, raw: String) -> String {
        let width = self.plan.channels[channel].elements.len();
        match (&term.source, &self.whole[channel]) {
            (Source::Columns { columns, .. }, Some(whole)) => {
                let all = match self.done.get(&raw) {
                    Some(all) => all.clone(),
                    None => whole.process(net, raw.clone()),
                };
                self.done.insert(raw, all.clone());
                net.columns(all, columns, width)
            }
            (Source::Columns { columns, .. }, None) => {
                let picked = net.columns(raw, columns, width);
                finished(net, term, picked)
            }
            (Source::Gravity { columns, .. }, _) => {
                let value = gravity(net, &raw, columns);
                finished(net, term, value)
            }
            _ => raw,
        }
    }

    /// Builds a value that the runtime makes itself, `[1, width]`; `None` for a value that the
    /// caller gives.
    fn own(&mut self, net: &mut Net, term: &Term) -> Option<String> {
        let value = match &term.source {
            Source::Action => {
                if !self.last_action {
                    self.last_action = true;
                    let shape = [1, self.plan.action.scale.len()];
                    net.input(LAST_ACTION, &shape);
                    net.kept.push(Kept::plain(LAST_ACTION, &shape));
                }
                entry(LAST_ACTION)
            }
            Source::Phase { turn, hands } => self.clock(net, *turn, hands),
            Source::Step => self.steps(net),
            Source::First => {
                // 1 at step 0, then 0.
                let steps = self.steps(net);
                let one = net.floats(&[1, 1], &[1.0]);
                let late = net.op("Min", &[&steps, &one], vec![]);
                net.op("Sub", &[&one, &late], vec![])
            }
            Source::Output(edge) => net.leave(edge, &[1, edge.len()]),
            Source::Columns { .. } | Source::Gravity { .. } => return None,
        };
        Some(value)
    }

    fn steps(&mut self, net: &mut Net) -> String {
        if !self.steps {
            self.steps = true;
            net.input(STEPS, &[1, 1]);
            net.kept.push(Kept::plain(STEPS, &[1, 1]));
        }
        entry(STEPS)
    }

    /// Builds sines and cosines of the clock, from a state of `cos - 1, sin` that is zero at first
    /// and turns by a constant angle.
    fn clock(&mut self, net: &mut Net, turn: f64, hands: &[(Wave, f64)]) -> String {
        if self.clock.is_none() {
            self.clock = Some(turn);
            net.input(CLOCK, &[1, 2]);
            net.kept.push(Kept::plain(CLOCK, &[1, 2]));
        }
        let now = clock_now(net);
        let mut matrix = vec![0.0; 2 * hands.len()];
        for (i, (wave, ahead)) in hands.iter().enumerate() {
            let (sin, cos) = (std::f64::consts::TAU * ahead).sin_cos();
            let (of_cos, of_sin) = match wave {
                Wave::Sin => (sin, cos),
                Wave::Cos => (cos, -sin),
            };
            matrix[i] = of_cos;
            matrix[hands.len() + i] = of_sin;
        }
        let matrix = net.floats(&[2, hands.len()], &matrix);
        net.op("MatMul", &[&now, &matrix], vec![])
    }

    /// Builds the next values of the terms' states.
    pub fn finish(&mut self, net: &mut Net, raw_action: &str) {
        let width = self.plan.action.scale.len();
        if self.last_action {
            net.output(&format!("next_{LAST_ACTION}"), raw_action, &[1, width]);
        }
        if self.steps {
            let (now, one) = (entry(STEPS), net.floats(&[1, 1], &[1.0]));
            let next = net.op("Add", &[&now, &one], vec![]);
            net.output(&format!("next_{STEPS}"), &next, &[1, 1]);
        }
        if let Some(turn) = self.clock {
            let now = clock_now(net);
            let (sin, cos) = turn.sin_cos();
            let matrix = net.floats(&[2, 2], &[cos, sin, -sin, cos]);
            let turned = net.op("MatMul", &[&now, &matrix], vec![]);
            // Back to length 1, so that rounding never adds up.
            let square = net.op("Mul", &[&turned, &turned], vec![]);
            let ones = net.floats(&[2, 1], &[1.0, 1.0]);
            let sum = net.op("MatMul", &[&square, &ones], vec![]);
            let length = net.op("Sqrt", &[&sum], vec![]);
            let unit = net.op("Div", &[&turned, &length], vec![]);
            let next = net.moved("Sub", unit, &[1.0, 0.0]);
            net.output(&format!("next_{CLOCK}"), &next, &[1, 2]);
        }
    }
}

/// Builds cosine and sine of the clock, `[1, 2]`.
fn clock_now(net: &mut Net) -> String {
    let state = entry(CLOCK);
    net.moved("Add", state, &[1.0, 0.0])
}

/// Returns the longest history of a channel that begins with its first step.
fn longest(plan: &Plan, wanted: usize) -> usize {
    let terms = plan.feeds.iter().flat_map(|(_, feed)| match feed {
        Feed::Terms { terms, stack, .. } if stack.start == Start::First => &terms[..],
        _ => &[],
    });
    let of_channel = terms.filter(|term| match term.source {
        Source::Columns { channel, .. } | Source::Gravity { channel, .. } => channel == wanted,
        _ => false,
    });
    of_channel.map(|term| term.history).max().unwrap_or(1)
}

fn finished(net: &mut Net, term: &Term, value: String) -> String {
    let value = net.moved("Sub", value, &term.offset);
    let value = net.clipped(value, term.clip.as_ref());
    net.scaled(value, &term.scale)
}

/// Computes the direction of gravity in the body's frame, from orientations of any length but zero:
/// `2 (wy - xz), -2 (yz + wx), 2 (xx + yy) / 1 - 1`, each product divided by the squared length.
fn gravity(net: &mut Net, raw: &str, columns: &[usize; 4]) -> String {
    let columns: Vec<i64> = columns.iter().map(|&column| column as i64).collect();
    let [w, x, y, z] = [0, 1, 2, 3].map(|i: usize| net.gathered(raw, &columns[i..=i], 1));
    let mut product = |a: &str, b: &str| net.op("Mul", &[a, b], vec![]);
    let [wy, xz, yz, wx] = [(&w, &y), (&x, &z), (&y, &z), (&w, &x)].map(|(a, b)| product(a, b));
    let [ww, xx, yy, zz] = [&w, &x, &y, &z].map(|a| product(a, a));
    let mut pair = |operator: &str, a: &str, b: &str| net.op(operator, &[a, b], vec![]);
    let (forward, left, down) = (
        pair("Sub", &wy, &xz),
        pair("Add", &yz, &wx),
        pair("Add", &xx, &yy),
    );
    let rest = pair("Add", &ww, &zz);
    let square = pair("Add", &down, &rest);
    let parts = net.joined(&[forward, left, down], 1);
    let parts = net.scaled(parts, &[2.0, -2.0, 2.0]);
    let parts = net.op("Div", &[&parts, &square], vec![]);
    net.moved("Sub", parts, &[0.0, 0.0, 1.0])
}
