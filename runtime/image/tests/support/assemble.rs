//! Assembles the programs of a [`Model`] from ops, by hand.

#[path = "draft.rs"]
mod draft;

use lads_image::op::{
    self, Activation, CacheFormat, IntSlot, OP_WORDS, Op, Place, Span, StateSpan, WeightSpan,
};
use lads_image::{Program, ProgramError, Spaces};
use lads_kernels::attention_scratch_len;

pub use draft::{Draft, TIMESTEP};
use draft::{Packed, Pool};

use super::model::{ALPHA, Dense, Model};

/// The programs of a policy, in the order of [`Assembled::programs`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Instruct,
    Start,
    StepDecide,
    StepRecord,
    Lookup,
    Act,
    Encode,
}

/// A policy assembled by hand: its programs, weights and sizes.
#[derive(Clone)]
pub struct Assembled {
    pub programs: [Draft; 7],
    pub weights: Vec<f32>,
    pub cache_len: u32,
    pub rows: u32,
}

impl Assembled {
    pub fn draft(&self, kind: Kind) -> &Draft {
        &self.programs[kind as usize]
    }

    pub fn draft_mut(&mut self, kind: Kind) -> &mut Draft {
        &mut self.programs[kind as usize]
    }

    pub fn encode(&self, kind: Kind) -> Vec<[u32; OP_WORDS]> {
        self.draft(kind).ops.iter().map(Op::encode).collect()
    }

    pub fn spaces(&self) -> Spaces {
        Spaces {
            weights_len: self.weights.len(),
            cache_len: self.cache_len as usize,
            rows: self.rows as usize,
        }
    }

    /// Checks a program whose words are `ops`.
    pub fn check<'o>(
        &self,
        kind: Kind,
        ops: &'o [[u32; OP_WORDS]],
    ) -> Result<Program<'o>, ProgramError> {
        let draft = self.draft(kind);
        let ports = draft.inputs.iter().chain(&draft.outputs);
        let places = ports.map(|&(_, place)| place);
        Program::new_checked(ops, draft.arena_len, draft.tokens, self.spaces(), places)
    }
}

pub const INDEX: IntSlot = IntSlot(1);

/// One transformer layer in the weights, and its cache.
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

/// Weights of the transformer.
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
    /// Adds the layers over `x`; with `decide` the logits of the last token, otherwise only keys
    /// and values.
    fn run(&self, draft: &mut Draft, x: Span, decide: bool) {
        let tokens = x.len / self.width;
        let mut x = draft.norm(x, self.norm_embed);
        for (i, layer) in self.layers.iter().enumerate() {
            let last = i + 1 == self.layers.len();
            let queries = if last { u32::from(decide) } else { tokens };
            let normed = draft.norm(x, layer.norm1);
            let qkv = draft.span(tokens * 3 * self.width);
            draft.linear(normed, layer.qkv, qkv, Activation::None, false);
            let attended = self.attend(draft, layer, qkv, queries);
            if queries == 0 {
                return;
            }
            let dropped = (tokens - queries) * self.width;
            x = Span {
                offset: x.offset + dropped,
                len: x.len - dropped,
            };
            draft.linear(attended, layer.out, x, Activation::None, true);
            let normed = draft.norm(x, layer.norm2);
            let hidden = draft.span(queries * layer.up.n);
            draft.linear(normed, layer.up, hidden, Activation::Relu, false);
            draft.linear(hidden, layer.down, x, Activation::None, true);
        }
        let normed = draft.norm(x, self.norm_final);
        let logits = draft.span(self.head.n);
        draft.linear(normed, self.head, logits, Activation::None, false);
        draft.output("logits", Place::Span(logits));
    }

    fn attend(&self, draft: &mut Draft, layer: &PackedLayer, qkv: Span, queries: u32) -> Span {
        let (width, stride) = (self.width, 3 * self.width);
        let tokens = qkv.len / stride;
        let scratch = attention_scratch_len(
            queries as usize,
            self.heads as usize,
            self.capacity as usize,
        ) as u32;
        let (y, scratch) = (draft.span(queries * width), draft.span(scratch));
        let part = |first: u32, rows: u32| Span {
            offset: qkv.offset + (tokens - rows) * stride + first * width,
            len: (rows - 1) * stride + width,
        };
        let (q, y, scratch) = if queries == 0 {
            Default::default()
        } else {
            (part(0, queries), y, scratch)
        };
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

/// Assembles the programs of a model, its weights and its KV cache.
pub fn assemble(model: &Model) -> Assembled {
    let spec = model.spec;
    let d = spec.width() as u32;
    let mut pool = Pool(Vec::new());
    let capacity = (spec.words_len + 1 + 2 * (spec.steps - 1)) as u32;
    let mut cache_len = 0;
    let mut cache = |rows: u32| {
        let span = StateSpan {
            offset: cache_len,
            len: rows * d,
        };
        cache_len += span.len;
        span
    };
    let layers = model.layers.iter().map(|layer| PackedLayer {
        norm1: pool.norm(&layer.norm1),
        qkv: pool.dense(&layer.qkv),
        out: pool.dense(&layer.out),
        norm2: pool.norm(&layer.norm2),
        up: pool.dense(&layer.up),
        down: pool.dense(&layer.down),
        cache_k: cache(capacity.next_multiple_of(16)),
        cache_v: cache(capacity),
    });
    let layers = layers.collect();
    let transformer = Transformer {
        width: d,
        heads: spec.heads as u32,
        head_dim: spec.head_dim as u32,
        capacity,
        norm_embed: pool.norm(&model.norm_embed),
        layers,
        norm_final: pool.norm(&model.norm_final),
        head: pool.dense(&model.head),
    };
    let embed_words = pool.dense(&model.embed_words);
    let embed_observation = pool.dense(&model.embed_observation);
    let embed_action = pool.dense(&model.embed_action);
    let timesteps = pool.add(&model.timesteps);

    let mut instruct = Draft::new(spec.words_len);
    let words = instruct.input_span("words", spec.words_len * spec.word_dim);
    let x = instruct.span(spec.words_len as u32 * d);
    instruct.linear(words, embed_words, x, Activation::None, false);
    transformer.run(&mut instruct, x, false);

    let mut start = Draft::new(1);
    start.input("timestep", Place::Int(TIMESTEP));
    let observation = start.input_span("observation", spec.observation_len);
    let x = start.span(d);
    start.linear(observation, embed_observation, x, Activation::None, false);
    start.add_timestep(x, timesteps, 0);
    transformer.run(&mut start, x, true);

    let step = |decide| {
        let mut step = Draft::new(2);
        step.input("timestep", Place::Int(TIMESTEP));
        let action = step.input_span("action", spec.action_len);
        let observation = step.input_span("observation", spec.observation_len);
        let x = step.span(2 * d);
        let rows = [
            Span { len: d, ..x },
            Span {
                offset: x.offset + d,
                len: d,
            },
        ];
        step.linear(action, embed_action, rows[0], Activation::None, false);
        step.linear(
            observation,
            embed_observation,
            rows[1],
            Activation::None,
            false,
        );
        step.add_timestep(rows[0], timesteps, -1);
        step.add_timestep(rows[1], timesteps, 0);
        transformer.run(&mut step, x, decide);
        step
    };

    let (lookup, act, encode) = (
        lookup(model, &mut pool),
        act(model, &mut pool),
        encode(model, &mut pool),
    );
    Assembled {
        programs: [
            instruct,
            start,
            step(true),
            step(false),
            lookup,
            act,
            encode,
        ],
        weights: pool.0,
        cache_len,
        rows: capacity,
    }
}

fn lookup(model: &Model, pool: &mut Pool) -> Draft {
    let spec = model.spec;
    let mut lookup = Draft::new(0);
    lookup.input("plan_index", Place::Int(INDEX));
    let plan = lookup.span(spec.plan_len as u32);
    lookup.op(op::GatherRow {
        table: pool.add(&model.codebook).into(),
        row_len: plan.len,
        rows: spec.codebook_len as u32,
        index: INDEX,
        shift: 0,
        y: plan,
    });
    lookup.output("plan", Place::Span(plan));
    lookup
}

fn act(model: &Model, pool: &mut Pool) -> Draft {
    let spec = model.spec;
    let mut act = Draft::new(0);
    // The two inputs lie side by side, so no copy joins them.
    let observation = act.input_span("observation", spec.observation_len);
    let plan = act.input_span("plan", spec.plan_len);
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
        act.linear(x, pool.dense(dense), y, activation, false);
        x = y;
    }
    act.output("action", Place::Span(x));
    act
}

/// Adds the encoder, which picks the code `c` of the smallest squared distance
/// `|x|^2 - 2 x·c + |c|^2`; the first term is left out, as it is the same for all codes.
fn encode(model: &Model, pool: &mut Pool) -> Draft {
    let spec = model.spec;
    let mut encode = Draft::new(0);
    let observations = encode.input_span("observations", spec.horizon * spec.observation_len);
    let actions = encode.input_span("actions", spec.horizon * spec.action_len);
    let x = Span {
        offset: observations.offset,
        len: observations.len + actions.len,
    };
    let latent = encode.span(spec.plan_len as u32);
    encode.linear(
        x,
        pool.dense(&model.encoder),
        latent,
        Activation::None,
        false,
    );
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
    encode.linear(
        latent,
        pool.dense(&distance),
        distances,
        Activation::None,
        false,
    );
    encode.op(op::ArgMin {
        x: distances,
        out: INDEX,
    });
    encode.output("plan_index", Place::Int(INDEX));
    encode.output("latent", Place::Span(latent));
    encode
}
