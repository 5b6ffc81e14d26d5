//! Assembles a [`Model`] into the parts of an image: programs from ops by hand, the schedule of LADS around them.

use lads_image::op::{self, Activation, BinaryKind, CacheFormat, Span, StateSpan, WeightSpan};
use lads_image::place::Place;
use lads_image::records::{DType, Event, Role, Scope, SourceKind};
use lads_kernels::{attention_scratch_len, keys_len, pack, packed_len};

use super::draft::{Draft, bound};
use super::model::{ALPHA, Dense, EPS, Model, Norm};
use super::writer::{Call, Parts};

/// Entries of the image, by their number.
pub const INSTRUCT: usize = 0;
pub const START: usize = 1;
pub const DECIDE: usize = 2;
pub const RECORD: usize = 3;
pub const LOOKUP: usize = 4;
pub const ACT: usize = 5;
pub const ENCODE: usize = 6;

/// States of the image, by their number.
pub const CONTEXT: u32 = 0;
pub const LOGITS: u32 = 1;
pub const PLAN: u32 = 2;

/// Channels of the image, by their number.
pub const OBSERVATION: u32 = 0;
pub const WORDS: u32 = 1;
pub const OBSERVATIONS: u32 = 2;
pub const ACTIONS: u32 = 3;
pub const ACTION: u32 = 4;

/// A dense layer in the weights.
#[derive(Clone, Copy)]
struct Packed {
    k: u32,
    n: u32,
    w: WeightSpan,
    b: WeightSpan,
}

impl Packed {
    fn new(parts: &mut Parts, dense: &Dense) -> Self {
        let (format, shape) = (op::WeightFormat::F32, [dense.k, dense.n]);
        let mut panels = vec![0.0; packed_len(format, shape)];
        pack(format, &dense.w, shape, &mut panels);
        Self {
            k: dense.k as u32,
            n: dense.n as u32,
            w: parts.weights(&panels),
            b: parts.weights(&dense.b),
        }
    }

    /// `y = activation(x W + b)`, or added to `y`.
    fn run(self, draft: &mut Draft, x: Span, y: Span, activation: Activation, accumulate: bool) {
        let Self { k, n, w, b } = self;
        draft.op(op::Linear {
            x,
            format: op::WeightFormat::F32,
            w,
            scales: None,
            bias: Some(b),
            y,
            m: x.len / k,
            k,
            n,
            activation,
            accumulate,
        });
    }
}

fn norm(parts: &mut Parts, norm: &Norm) -> [WeightSpan; 2] {
    [parts.weights(&norm.gamma), parts.weights(&norm.beta)]
}

fn layer_norm(draft: &mut Draft, x: Span, [gamma, beta]: [WeightSpan; 2]) -> Span {
    let y = draft.span(x.len);
    draft.op(op::LayerNorm {
        x,
        y,
        gamma,
        beta,
        rows: x.len / gamma.len,
        cols: gamma.len,
        eps: EPS,
    });
    y
}

/// `x += table[timestep + shift]`
fn add_timestep(draft: &mut Draft, x: Span, table: WeightSpan, shift: i32) {
    let timestep = op::IntSlot(0);
    let row = draft.gather(table, x.len, timestep, shift);
    draft.op(op::Binary {
        kind: BinaryKind::Add,
        a: x.into(),
        b: row.into(),
        y: x,
        dims: [1, 1, 1, x.len],
        a_strides: [0, 0, 0, 1],
        b_strides: [0, 0, 0, 1],
    });
}

/// One transformer layer in the weights, and its part of the cache.
struct PackedLayer {
    norm1: [WeightSpan; 2],
    qkv: Packed,
    out: Packed,
    norm2: [WeightSpan; 2],
    up: Packed,
    down: Packed,
    cache_k: StateSpan,
    cache_v: StateSpan,
}

/// The transformer's weights.
struct Transformer {
    width: u32,
    heads: u32,
    head_dim: u32,
    capacity: u32,
    norm_embed: [WeightSpan; 2],
    layers: Vec<PackedLayer>,
    norm_final: [WeightSpan; 2],
    head: Packed,
}

impl Transformer {
    /// The layers over `x`; with `decide` the logits of the last token, otherwise only keys and values.
    fn run(&self, draft: &mut Draft, x: Span, decide: bool) {
        let tokens = x.len / self.width;
        let mut x = layer_norm(draft, x, self.norm_embed);
        for (i, layer) in self.layers.iter().enumerate() {
            let last = i + 1 == self.layers.len();
            let queries = if last { u32::from(decide) } else { tokens };
            let normed = layer_norm(draft, x, layer.norm1);
            let qkv = draft.span(tokens * 3 * self.width);
            layer.qkv.run(draft, normed, qkv, Activation::None, false);
            let attended = self.attend(draft, layer, qkv, queries);
            if queries == 0 {
                return;
            }
            let dropped = (tokens - queries) * self.width;
            x = Span {
                offset: x.offset + dropped,
                len: x.len - dropped,
            };
            layer.out.run(draft, attended, x, Activation::None, true);
            let normed = layer_norm(draft, x, layer.norm2);
            let hidden = draft.span(queries * layer.up.n);
            layer.up.run(draft, normed, hidden, Activation::Relu, false);
            layer.down.run(draft, hidden, x, Activation::None, true);
        }
        let normed = layer_norm(draft, x, self.norm_final);
        let logits = draft.span(self.head.n);
        self.head
            .run(draft, normed, logits, Activation::None, false);
        draft.gives_state(LOGITS, logits);
    }

    fn attend(&self, draft: &mut Draft, layer: &PackedLayer, qkv: Span, queries: u32) -> Span {
        let (width, stride) = (self.width, 3 * self.width);
        let tokens = qkv.len / stride;
        let part = |first: u32, rows: u32| Span {
            offset: qkv.offset + (tokens - rows) * stride + first * width,
            len: (rows - 1) * stride + width,
        };
        let (mut q, mut y, mut scratch) = Default::default();
        if queries > 0 {
            let lens = (
                queries as usize,
                self.heads as usize,
                self.capacity as usize,
            );
            q = part(0, queries);
            y = draft.span(queries * width);
            scratch = draft.span(attention_scratch_len(lens.0, lens.1, lens.2) as u32);
        }
        draft.op(op::Attention {
            q,
            q_stride: stride,
            k: part(1, tokens),
            k_stride: stride,
            v: part(2, tokens),
            v_stride: stride,
            y,
            format: CacheFormat::F32,
            cache_k: layer.cache_k,
            cache_v: layer.cache_v,
            heads: self.heads,
            head_dim: self.head_dim,
            tokens,
            queries,
            scale: 1.0 / (self.head_dim as f32).sqrt(),
            scratch,
        });
        y
    }
}

/// The parts of an image of a model.
pub fn parts(model: &Model) -> Parts {
    let spec = model.spec;
    let d = spec.width() as u32;
    let mut parts = Parts::new("lads");
    let [o, a] = [spec.observation_len as u32, spec.action_len as u32];
    let h = spec.horizon as u32;
    let inside = [-3.0, 3.0];
    parts.channel("observation", Role::Observation, DType::F32, &[o], inside);
    let shape = [spec.words_len as u32, spec.word_dim as u32];
    parts.channel("words", Role::Instruction, DType::F32, &shape, [-9.0, 9.0]);
    parts.channel(
        "observations",
        Role::Demonstration,
        DType::F32,
        &[h, o],
        inside,
    );
    parts.channel(
        "actions",
        Role::Demonstration,
        DType::F32,
        &[h, a],
        [-1.0, 1.0],
    );
    parts.channel("action", Role::Action, DType::F32, &[a], [-1.0, 1.0]);
    parts.contract.context_steps = spec.steps as u32;
    for words in &model.instructions {
        parts.instruction(spec.word_dim, words);
    }

    let capacity = (spec.words_len + 1 + 2 * (spec.steps - 1)) as u32;
    let mut cache_len = 0;
    let mut cache = |len: u32| {
        let span = StateSpan {
            offset: cache_len,
            len,
        };
        cache_len += len;
        span
    };
    let layers: Vec<_> = model
        .layers
        .iter()
        .map(|layer| PackedLayer {
            norm1: norm(&mut parts, &layer.norm1),
            qkv: Packed::new(&mut parts, &layer.qkv),
            out: Packed::new(&mut parts, &layer.out),
            norm2: norm(&mut parts, &layer.norm2),
            up: Packed::new(&mut parts, &layer.up),
            down: Packed::new(&mut parts, &layer.down),
            cache_k: cache(keys_len(capacity as usize, d as usize) as u32),
            cache_v: cache(capacity * d),
        })
        .collect();
    let transformer = Transformer {
        width: d,
        heads: spec.heads as u32,
        head_dim: spec.head_dim as u32,
        capacity,
        norm_embed: norm(&mut parts, &model.norm_embed),
        layers,
        norm_final: norm(&mut parts, &model.norm_final),
        head: Packed::new(&mut parts, &model.head),
    };
    parts.kv("context", cache_len, capacity);
    parts.plain("logits", Scope::Episode, spec.codebook_len as u32);
    parts.plain("plan", Scope::Episode, spec.plan_len as u32);
    high_level(model, &mut parts, &transformer);
    lookup(model, &mut parts);
    act(model, &mut parts);
    encode(model, &mut parts);
    schedule(&mut parts, h);
    parts.sealed()
}

fn schedule(parts: &mut Parts, h: u32) {
    let entry = |entry: usize| entry as u32;
    parts.calls = vec![
        Call::on(Event::Instruct, entry(INSTRUCT)),
        Call::step(entry(START)).first().select(LOGITS),
        Call::step(entry(DECIDE))
            .every(h)
            .otherwise()
            .select(LOGITS),
        Call::step(entry(RECORD)).otherwise(),
        Call::step(entry(LOOKUP)).every(h),
        Call::step(entry(ACT)),
        Call::on(Event::Follow, entry(LOOKUP)),
        Call::on(Event::Follow, entry(ACT)),
        Call::on(Event::Encode, entry(ENCODE)),
    ];
}

fn high_level(model: &Model, parts: &mut Parts, transformer: &Transformer) {
    let spec = model.spec;
    let d = transformer.width;
    let embed_words = Packed::new(parts, &model.embed_words);
    let embed_observation = Packed::new(parts, &model.embed_observation);
    let embed_action = Packed::new(parts, &model.embed_action);
    let timesteps = parts.weights(&model.timesteps);

    let mut instruct = Draft::appending("high_level/instruct", CONTEXT, spec.words_len as u32);
    let words = instruct.channel(WORDS, (spec.words_len * spec.word_dim) as u32);
    let x = instruct.span(spec.words_len as u32 * d);
    embed_words.run(&mut instruct, words, x, Activation::None, false);
    transformer.run(&mut instruct, x, false);
    parts.entry(instruct.finish());

    let mut start = Draft::appending("high_level/start", CONTEXT, 1);
    start.int(SourceKind::Timestep, 0, 0);
    let observation = start.channel(OBSERVATION, spec.observation_len as u32);
    let x = start.span(d);
    embed_observation.run(&mut start, observation, x, Activation::None, false);
    add_timestep(&mut start, x, timesteps, 0);
    transformer.run(&mut start, x, true);
    parts.entry(start.finish());

    for (name, decide) in [("high_level/step", true), ("high_level/record", false)] {
        let mut step = Draft::appending(name, CONTEXT, 2);
        step.int(SourceKind::Timestep, 0, 0);
        let action = step.channel(ACTION, spec.action_len as u32);
        let observation = step.channel(OBSERVATION, spec.observation_len as u32);
        let x = step.span(2 * d);
        let (first, second) = (
            Span { len: d, ..x },
            Span {
                offset: x.offset + d,
                len: d,
            },
        );
        embed_action.run(&mut step, action, first, Activation::None, false);
        embed_observation.run(&mut step, observation, second, Activation::None, false);
        add_timestep(&mut step, first, timesteps, -1);
        add_timestep(&mut step, second, timesteps, 0);
        transformer.run(&mut step, x, decide);
        parts.entry(step.finish());
    }
}

fn lookup(model: &Model, parts: &mut Parts) {
    let codebook = parts.weights(&model.codebook);
    let mut lookup = Draft::new("codebook/lookup");
    let index = lookup.int(SourceKind::Selected, 0, 1);
    let plan = lookup.gather(codebook, model.spec.plan_len as u32, index, 0);
    lookup.gives_state(PLAN, plan);
    parts.entry(lookup.finish());
}

fn act(model: &Model, parts: &mut Parts) {
    let spec = model.spec;
    let mut act = Draft::new("low_level/act");
    // The two inputs lie side by side, so no copy joins them.
    let observation = act.channel(OBSERVATION, spec.observation_len as u32);
    let plan = act.state(PLAN, spec.plan_len as u32);
    let mut x = Span {
        offset: observation.offset,
        len: observation.len + plan.len,
    };
    for (i, dense) in model.low.iter().enumerate() {
        let last = i + 1 == model.low.len();
        let y = act.span(dense.n as u32);
        let activation = if last {
            Activation::None
        } else {
            Activation::LeakyRelu(ALPHA)
        };
        Packed::new(parts, dense).run(&mut act, x, y, activation, false);
        x = y;
    }
    act.gives_channel(ACTION, x);
    parts.entry(act.finish());
}

/// Squared distance to code `c` is `|x|^2 - 2 x·c + |c|^2`; the first term is the same for all codes.
fn encode(model: &Model, parts: &mut Parts) {
    let spec = model.spec;
    let mut encode = Draft::new("trajectory_encoder/encode");
    let observations = encode.channel(OBSERVATIONS, (spec.horizon * spec.observation_len) as u32);
    let actions = encode.channel(ACTIONS, (spec.horizon * spec.action_len) as u32);
    let x = Span {
        offset: observations.offset,
        len: observations.len + actions.len,
    };
    let latent = encode.span(spec.plan_len as u32);
    Packed::new(parts, &model.encoder).run(&mut encode, x, latent, Activation::None, false);
    let codes = spec.codebook_len;
    let mut distance = Dense {
        k: spec.plan_len,
        n: codes,
        w: vec![0.0; spec.plan_len * codes],
        b: vec![0.0; codes],
    };
    for c in 0..codes {
        for (i, &value) in model.plan(c).iter().enumerate() {
            distance.w[i * codes + c] = -2.0 * value;
            distance.b[c] += value * value;
        }
    }
    let distances = encode.span(codes as u32);
    Packed::new(parts, &distance).run(&mut encode, latent, distances, Activation::None, false);
    let out = op::IntSlot(1);
    encode.op(op::ArgMin { x: distances, out });
    encode.output(bound(SourceKind::Selected, 0), Place::Int(out));
    parts.entry(encode.finish());
}
