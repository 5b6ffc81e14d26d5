//! The smallest image of each shape that a schedule can have. Their weights are constants, which
//! the reference implementations in `tests/shapes.rs` read too.

use lads_image::records::{DType, Event, Fill, Role, Scope, SourceKind};

use super::draft::{Draft, bound, kv_len};
use super::writer::{Call, Parts};

/// Weights with rows of two elements for three indices.
pub const CODES: [[f32; 2]; 3] = [[0.5, -0.25], [-0.75, 0.125], [0.25, 0.875]];

/// Weights of the scores of three indices, `observation · LEANS`.
pub const LEANS: [[f32; 3]; 2] = [[0.5, -1.0, 0.25], [-0.5, 0.75, 1.0]];

/// Weights with rows of two elements for timesteps, passes and phases.
pub const STEPS: [[f32; 2]; 6] = [
    [0.125, 0.25],
    [-0.25, 0.5],
    [0.375, -0.125],
    [0.0, 0.75],
    [-0.5, -0.375],
    [0.625, 0.0],
];

/// Word embeddings of two instructions: two words of two elements, and one.
pub const WORDS: [&[f32]; 2] = [&[0.5, -1.0, 0.25, 0.75], &[-0.5, 0.25]];

/// Returns a name and an image for every shape.
pub fn all() -> Vec<(&'static str, Parts)> {
    vec![
        ("chunks", chunks()),
        ("denoise", denoise()),
        ("window of zeros", window(Fill::Zero)),
        ("window of the first", window(Fill::First)),
        ("history", history()),
        ("queue", queue()),
        ("recurrent", recurrent()),
        ("memoryless", memoryless()),
        ("camera", camera()),
    ]
}

fn parts(name: &str) -> Parts {
    let mut parts = Parts::new(name);
    parts.channel(
        "observation",
        Role::Observation,
        DType::F32,
        &[2],
        [-3.0, 3.0],
    );
    parts.channel("action", Role::Action, DType::F32, &[2], [-1.0, 1.0]);
    parts
}

/// Numbers of the channels of [`parts`].
pub const OBSERVATION: u32 = 0;
pub const ACTION: u32 = 1;

fn words(parts: &mut Parts) -> u32 {
    let channel = parts.channel("words", Role::Instruction, DType::F32, &[2, 2], [-9.0, 9.0]);
    for words in WORDS {
        parts.instruction(2, words);
    }
    channel
}

/// Adds the entry that computes scores from the observation.
fn score(parts: &mut Parts, logits: u32) -> u32 {
    let leans = parts.weights(LEANS.as_flattened());
    let mut score = Draft::new("high_level/step");
    let observation = score.channel(OBSERVATION, 2);
    let scores = score.product(observation, leans);
    score.gives_state(logits, scores);
    parts.entry(score.finish())
}

/// Makes a policy with two KV caches, the second of which is cleared with every selection.
///
/// The first cache sees the words and one token a step, `observation + STEPS[t]`; scores are what
/// it attends to times `LEANS`. The second cache sees `[code, observation]` at a selection and
/// `[previous action, code, observation]` else; the action is what it attends to. Selections are
/// two steps apart, contexts have four steps.
pub fn chunks() -> Parts {
    let mut parts = parts("chunks");
    let words = words(&mut parts);
    parts.contract.context_steps = 4;
    let context = parts.kv("context", kv_len(6, 2), 6);
    let chunk = parts.kv("chunk", kv_len(5, 2), 5);
    let logits = parts.plain("logits", Scope::Episode, 3);
    let leans = parts.weights(LEANS.as_flattened());
    let timesteps = parts.weights(STEPS[..4].as_flattened());
    let codes = parts.weights(CODES.as_flattened());

    let mut instruct = Draft::appending("high_level/instruct", context, 2);
    let tokens = instruct.channel(words, 4);
    instruct.attend(tokens, 6, false);
    let instruct = parts.entry(instruct.finish());

    let [step, record] = [true, false].map(|decides| {
        let mut step = Draft::appending(
            if decides {
                "high_level/step"
            } else {
                "high_level/record"
            },
            context,
            1,
        );
        let observation = step.channel(OBSERVATION, 2);
        let timestep = step.int(SourceKind::Timestep, 0, 0);
        let row = step.gather(timesteps, 2, timestep, 0);
        let token = step.add(observation, row);
        let attended = step.attend(token, 6, decides);
        if decides {
            let scores = step.product(attended, leans);
            step.gives_state(logits, scores);
        }
        parts.entry(step.finish())
    });

    let [low_start, low_step] = [2, 3].map(|tokens| {
        let mut low = Draft::appending(
            if tokens == 2 {
                "low_level/start"
            } else {
                "low_level/step"
            },
            chunk,
            tokens,
        );
        let index = low.int(SourceKind::Selected, 0, 3);
        let mut joined = Vec::new();
        if tokens == 3 {
            joined.push(low.channel(ACTION, 2));
        }
        let observation = low.channel(OBSERVATION, 2);
        joined.push(low.gather(codes, 2, index, 0));
        joined.push(observation);
        let joined = low.join(&joined);
        let action = low.attend(joined, 5, true);
        low.gives_channel(ACTION, action);
        parts.entry(low.finish())
    });
    parts.calls = vec![
        Call::on(Event::Instruct, instruct),
        Call::step(step).every(2).select(logits),
        Call::step(record).otherwise(),
        Call::step(low_start).every(2).clears(chunk),
        Call::step(low_step).otherwise(),
    ];
    parts.sealed()
}

/// Number of times that the action is denoised.
pub const PASSES: u32 = 3;

/// Noise channel of [`denoise`].
pub const NOISE: u32 = 2;

/// Makes a policy that selects at every step, then denoises: `x = 0.5 n_0`, three times
/// `x = (0.5 x + STEPS[pass]) + (0.25 n_i + CODES[index])`; the action is `x + observation`.
pub fn denoise() -> Parts {
    let mut parts = parts("denoise");
    parts.channel("noise", Role::Noise, DType::F32, &[2], [-9.0, 9.0]);
    let logits = parts.plain("logits", Scope::Episode, 3);
    let x = parts.plain("x", Scope::Step, 2);
    let score = score(&mut parts, logits);
    let [half, quarter] = [0.5, 0.25].map(|factor| parts.weights(&[factor]));
    let codes = parts.weights(CODES.as_flattened());
    let passes = parts.weights(STEPS[..PASSES as usize].as_flattened());

    let mut init = Draft::new("low_level/init");
    let noise = init.channel(NOISE, 2);
    let start = init.mul(noise, half);
    init.gives_state(x, start);
    let init = parts.entry(init.finish());

    let mut denoise = Draft::new("low_level/denoise");
    let before = denoise.state(x, 2);
    let pass = denoise.int(SourceKind::Pass, 0, 0);
    let index = denoise.int(SourceKind::Selected, 0, 7);
    let noise = denoise.channel(NOISE, 2);
    let kept = denoise.mul(before, half);
    let row = denoise.gather(passes, 2, pass, 0);
    let kept = denoise.add(kept, row);
    let drawn = denoise.mul(noise, quarter);
    let code = denoise.gather(codes, 2, index, 0);
    let drawn = denoise.add(drawn, code);
    let after = denoise.add(kept, drawn);
    denoise.gives_state(x, after);
    let denoise = parts.entry(denoise.finish());

    let mut act = Draft::new("low_level/act");
    let last = act.state(x, 2);
    let observation = act.channel(OBSERVATION, 2);
    let action = act.add(last, observation);
    act.gives_channel(ACTION, action);
    let act = parts.entry(act.finish());
    parts.calls = vec![
        Call::step(score).select(logits),
        Call::step(init),
        Call::step(denoise).times(PASSES),
        Call::step(act),
    ];
    parts.sealed()
}

/// Makes a policy that sees the last three observations: the action is
/// `(0.5 r_0 + 0.25 r_1) + r_2`, the oldest first.
pub fn window(fill: Fill) -> Parts {
    let mut parts = parts("window");
    let stack = parts.ring("stack", 2, 3, fill);
    let [half, quarter, one] = [0.5, 0.25, 1.0].map(|factor| parts.weights(&[factor]));
    let mut push = Draft::new("stack/append");
    let observation = push.channel(OBSERVATION, 2);
    let newest = push.mul(observation, one);
    push.gives_state(stack, newest);
    let push = parts.entry(push.finish());

    let mut act = Draft::new("policy/act");
    let rows = act.state(stack, 6);
    let row = |i: u32| lads_image::op::Span {
        offset: rows.offset + 2 * i,
        len: 2,
    };
    let (oldest, middle) = (act.mul(row(0), half), act.mul(row(1), quarter));
    let sum = act.add(oldest, middle);
    let action = act.add(sum, row(2));
    act.gives_channel(ACTION, action);
    let act = parts.entry(act.finish());
    parts.calls = vec![Call::step(push), Call::step(act)];
    parts.sealed()
}

/// Number of rows of the ring of [`history`].
pub const MEMORY: u32 = 3;

/// Makes a policy in which every second step of six clears a KV cache and fills it with
/// `CODES[index]` and, for every row of a ring, the row and `STEPS[pass]`. Every step appends
/// `[previous action, observation + STEPS[phase]]` to it, and its attention is the action; then
/// `previous action + observation` goes into the ring.
pub fn history() -> Parts {
    let mut parts = parts("history");
    parts.contract.context_steps = 6;
    let capacity = 1 + 2 * MEMORY + 2 * 2;
    let ring = parts.ring("row", 2, MEMORY, Fill::Zero);
    let chunk = parts.kv("chunk", kv_len(capacity, 2), capacity);
    let logits = parts.plain("logits", Scope::Episode, 3);
    let score = score(&mut parts, logits);
    let codes = parts.weights(CODES.as_flattened());
    let table = parts.weights(STEPS.as_flattened());

    let mut plan = Draft::appending("low_level/plan", chunk, 1);
    let index = plan.int(SourceKind::Selected, 0, 0);
    let code = plan.gather(codes, 2, index, 0);
    plan.attend(code, capacity, false);
    let plan = parts.entry(plan.finish());

    let mut recall = Draft::appending("low_level/recall", chunk, 2);
    let row = recall.input_span(bound(SourceKind::Row, ring), 2);
    let pass = recall.int(SourceKind::Pass, 0, 0);
    let place = recall.gather(table, 2, pass, 0);
    let tokens = recall.join(&[row, place]);
    recall.attend(tokens, capacity, false);
    let recall = parts.entry(recall.finish());

    let mut step = Draft::appending("low_level/step", chunk, 2);
    let previous = step.channel(ACTION, 2);
    let observation = step.channel(OBSERVATION, 2);
    let phase = step.int(SourceKind::Phase, 2, 0);
    let place = step.gather(table, 2, phase, 0);
    let placed = step.add(observation, place);
    let tokens = step.join(&[previous, placed]);
    let action = step.attend(tokens, capacity, true);
    step.gives_channel(ACTION, action);
    let step = parts.entry(step.finish());

    let mut append = Draft::new("memory/append");
    let previous = append.channel(ACTION, 2);
    let observation = append.channel(OBSERVATION, 2);
    let row = append.add(previous, observation);
    append.gives_state(ring, row);
    let append = parts.entry(append.finish());
    parts.calls = vec![
        Call::step(score).every(2).select(logits),
        Call::step(plan).every(2).clears(chunk),
        Call::step(recall).every(2).rows(ring),
        Call::step(step),
        Call::step(append),
    ];
    parts.sealed()
}

/// Makes a policy in which every third step fills a queue, `queue[i] = observation * STEPS[i]`; the
/// action is the row of the phase.
pub fn queue() -> Parts {
    let mut parts = parts("queue");
    let queue = parts.plain("queue", Scope::Episode, 6);
    let rows = [0, 1, 2].map(|i: usize| parts.weights(&STEPS[i]));
    let mut plan = Draft::new("low_level/plan");
    let observation = plan.channel(OBSERVATION, 2);
    let rows = rows.map(|row| plan.mul(observation, row));
    let filled = plan.join(&rows);
    plan.gives_state(queue, filled);
    let plan = parts.entry(plan.finish());

    let mut pop = Draft::new("low_level/pop");
    let rows = pop.state(queue, 6);
    let phase = pop.int(SourceKind::Phase, 3, 2);
    let action = pop.gather(rows, 2, phase, 0);
    pop.gives_channel(ACTION, action);
    let pop = parts.entry(pop.finish());
    parts.calls = vec![Call::step(plan).every(3), Call::step(pop)];
    parts.sealed()
}

/// Numbers of the states of [`recurrent`].
pub const HIDDEN: u32 = 0;
pub const GOAL: u32 = 1;
pub const COUNT: u32 = 2;

/// Makes a policy with recurrent states: `goal` is the sum of the two words;
/// `h = (0.5 h + observation) + goal` is forgotten with the episode and the context of five steps,
/// `count = count + 1` with the instruction; the action is `0.25 h + 0.125 count`.
pub fn recurrent() -> Parts {
    let mut parts = parts("recurrent");
    let words = words(&mut parts);
    parts.contract.context_steps = 5;
    let hidden = parts.plain("h", Scope::Episode, 2);
    let goal = parts.plain("goal", Scope::Instruction, 2);
    let count = parts.plain("count", Scope::Instruction, 1);
    let [half, quarter, eighth, one] =
        [0.5, 0.25, 0.125, 1.0].map(|factor| parts.weights(&[factor]));

    let mut instruct = Draft::new("policy/instruct");
    let both = instruct.channel(words, 4);
    let word = |i: u32| lads_image::op::Span {
        offset: both.offset + 2 * i,
        len: 2,
    };
    let sum = instruct.add(word(0), word(1));
    instruct.gives_state(goal, sum);
    let instruct = parts.entry(instruct.finish());

    let mut act = Draft::new("policy/act");
    let before = act.state(hidden, 2);
    let wanted = act.state(goal, 2);
    let counted = act.state(count, 1);
    let observation = act.channel(OBSERVATION, 2);
    let kept = act.mul(before, half);
    let sum = act.add(kept, observation);
    let after = act.add(sum, wanted);
    let next_count = act.add(counted, one);
    let (low, high) = (act.mul(after, quarter), act.mul(next_count, eighth));
    let action = act.add(low, high);
    act.gives_state(hidden, after);
    act.gives_state(count, next_count);
    act.gives_channel(ACTION, action);
    let act = parts.entry(act.finish());
    parts.calls = vec![Call::on(Event::Instruct, instruct), Call::step(act)];
    parts.sealed()
}

/// Makes a policy without memory or instruction and with contexts of three steps: the action is
/// `observation + STEPS[t]`.
pub fn memoryless() -> Parts {
    let mut parts = parts("memoryless");
    parts.contract.context_steps = 3;
    let timesteps = parts.weights(STEPS[..3].as_flattened());
    let mut act = Draft::new("policy/act");
    let observation = act.channel(OBSERVATION, 2);
    let timestep = act.int(SourceKind::Timestep, 0, 0);
    let row = act.gather(timesteps, 2, timestep, 0);
    let action = act.add(observation, row);
    act.gives_channel(ACTION, action);
    let act = parts.entry(act.finish());
    parts.calls = vec![Call::step(act)];
    parts.sealed()
}

/// Numbers of the channels of [`camera`] besides the first two.
pub const CAMERA: u32 = 2;
pub const GEAR: u32 = 3;
pub const TICKS: u32 = 4;

/// Makes a policy with a camera of two by two pixels, a gear in an integer slot and ticks as
/// numbers: the action is `(observation + STEPS[gear]) + (upper pixels / 256 + 0.125 ticks)`.
pub fn camera() -> Parts {
    let mut parts = parts("camera");
    parts.channel(
        "camera",
        Role::Observation,
        DType::U8,
        &[2, 2, 1],
        [0.0, 255.0],
    );
    parts.channel("gear", Role::Observation, DType::I32, &[1], [0.0, 3.0]);
    parts.channel("ticks", Role::Observation, DType::I32, &[2], [-4.0, 4.0]);
    let gears = parts.weights(STEPS[..4].as_flattened());
    let [pixel, tick] = [1.0 / 256.0, 0.125].map(|factor| parts.weights(&[factor]));
    let mut act = Draft::new("policy/act");
    let observation = act.channel(OBSERVATION, 2);
    let pixels = act.channel(CAMERA, 4);
    let gear = act.int(SourceKind::Channel, GEAR, 5);
    let ticks = act.channel(TICKS, 2);
    let row = act.gather(gears, 2, gear, 0);
    let upper = act.mul(lads_image::op::Span { len: 2, ..pixels }, pixel);
    let ticks = act.mul(ticks, tick);
    let (left, right) = (act.add(observation, row), act.add(upper, ticks));
    let action = act.add(left, right);
    act.gives_channel(ACTION, action);
    let act = parts.entry(act.finish());
    parts.calls = vec![Call::step(act)];
    parts.sealed()
}
