//! Plans the memory of a program: moves its buffers together, so that only those that live at the
//! same time are kept apart.
//!
//! A buffer lives from the first op that touches it to the last; inputs from the start, outputs to the end. Buffers are placed
//! from the largest to the smallest, each in the smallest gap that fits among those that live at the same time (greedy best
//! fit). The result is not trusted: [`verify`](crate::verify) proves it.

use lads_image::op::{Op, Place, Span};

use crate::lower::Lowered;

/// Alignment of buffers in elements: a cache line.
const ALIGN: u32 = 16;

/// A program whose spans lie in the real arena.
#[derive(Debug, Clone)]
pub(crate) struct Placed {
    pub ops: Vec<Op>,
    pub inputs: Vec<(String, Place)>,
    pub outputs: Vec<(String, Place)>,
    pub arena_len: u32,
    /// Lower bound of the arena: the largest sum of the lengths of buffers that live at the same
    /// time.
    pub lower_bound: u32,
}

/// Lifetime of a buffer: time 0 is before the first op, op `i` runs at time `i + 1`. It is `None`
/// until the buffer is touched.
type Life = Option<(usize, usize)>;

/// Plans a program's memory.
pub(crate) fn plan(lowered: &Lowered) -> Placed {
    let buffers = &lowered.buffers;
    let lives = lives(lowered);
    let offsets = place(buffers, &lives);
    let last = lowered.ops.len() + 1;
    let sum_at = |time: usize| -> u32 {
        let lives_then = |life: &Life| life.is_some_and(|(from, to)| (from..=to).contains(&time));
        buffers
            .iter()
            .zip(&lives)
            .filter(|(_, life)| lives_then(life))
            .map(|(buffer, _)| buffer.len)
            .sum()
    };
    let moved = |span: &mut Span| {
        let buffer = buffer_of(buffers, *span);
        span.offset = span.offset - buffers[buffer].offset + offsets[buffer];
    };
    let mut ops = lowered.ops.clone();
    for op in &mut ops {
        op.each_span(&mut |span| moved(span));
    }
    let ports = |ports: &[(String, Place)]| {
        let place = |place: Place| match place {
            Place::Span(mut span) => {
                moved(&mut span);
                Place::Span(span)
            }
            Place::Int(slot) => Place::Int(slot),
        };
        ports
            .iter()
            .map(|(name, at)| (name.clone(), place(*at)))
            .collect()
    };
    let ends = buffers
        .iter()
        .zip(&lives)
        .zip(&offsets)
        .filter(|((_, life), _)| life.is_some());
    Placed {
        ops,
        inputs: ports(&lowered.inputs),
        outputs: ports(&lowered.outputs),
        arena_len: ends
            .map(|((buffer, _), offset)| offset + buffer.len)
            .max()
            .unwrap_or(0),
        lower_bound: (0..=last).map(sum_at).max().unwrap_or(0),
    }
}

/// Returns the buffer that holds a span. Buffers are sorted by their offsets.
fn buffer_of(buffers: &[Span], span: Span) -> usize {
    buffers.partition_point(|buffer| buffer.offset <= span.offset) - 1
}

fn lives(lowered: &Lowered) -> Vec<Life> {
    let mut lives: Vec<Life> = vec![None; lowered.buffers.len()];
    let mut touch = |span: Span, time: usize| {
        let life = &mut lives[buffer_of(&lowered.buffers, span)];
        *life = Some(life.map_or((time, time), |(from, to)| (from.min(time), to.max(time))));
    };
    let spans = |ports: &[(String, Place)]| -> Vec<Span> {
        let span = |(_, place): &(String, Place)| match *place {
            Place::Span(span) => Some(span),
            Place::Int(_) => None,
        };
        ports.iter().filter_map(span).collect()
    };
    for span in spans(&lowered.inputs) {
        touch(span, 0);
    }
    for (i, op) in lowered.ops.iter().enumerate() {
        op.clone().each_span(&mut |span| touch(*span, i + 1));
    }
    for span in spans(&lowered.outputs) {
        touch(span, lowered.ops.len() + 1);
    }
    lives
}

/// Returns the offset of each buffer; for unused buffers, any number.
fn place(buffers: &[Span], lives: &[Life]) -> Vec<u32> {
    let mut offsets = vec![0; buffers.len()];
    let mut order: Vec<usize> = (0..buffers.len()).filter(|&i| lives[i].is_some()).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(buffers[i].len), lives[i], i));
    let mut done: Vec<usize> = vec![];
    for i in order {
        let beside = |&j: &usize| match (lives[i], lives[j]) {
            (Some((from, to)), Some((other_from, other_to))) => {
                from <= other_to && other_from <= to
            }
            _ => false,
        };
        let mut taken: Vec<(u32, u32)> = done
            .iter()
            .copied()
            .filter(beside)
            .map(|j| (offsets[j], offsets[j] + buffers[j].len))
            .collect();
        taken.sort_unstable();
        let mut free = 0;
        let mut best: Option<(u32, u32)> = None;
        for (start, end) in taken {
            let gap = start.saturating_sub(free);
            if gap >= buffers[i].len && best.is_none_or(|(size, _)| gap < size) {
                best = Some((gap, free));
            }
            free = free.max(end.next_multiple_of(ALIGN));
        }
        offsets[i] = best.map_or(free, |(_, start)| start);
        done.push(i);
    }
    offsets
}
