//! Naive network of LADS: every decision recomputes the whole token sequence in `f64`.

use super::Random;

/// Sizes of a policy.
#[derive(Clone, Copy)]
pub struct Spec {
    pub observation_len: usize,
    pub action_len: usize,
    pub codebook_len: usize,
    pub plan_len: usize,
    pub word_dim: usize,
    pub words_len: usize,
    pub layers: usize,
    pub heads: usize,
    pub head_dim: usize,
    pub hidden: usize,
    pub low_layers: usize,
    pub horizon: usize,
    pub steps: usize,
}

impl Spec {
    /// Odd sizes that fill no panel and no block.
    pub const TINY: Self = Self {
        observation_len: 3,
        action_len: 2,
        codebook_len: 5,
        plan_len: 3,
        word_dim: 4,
        words_len: 4,
        layers: 2,
        heads: 2,
        head_dim: 5,
        hidden: 12,
        low_layers: 2,
        horizon: 3,
        steps: 8,
    };

    /// Sizes of Kitchen (state) in the paper.
    pub const KITCHEN: Self = Self {
        observation_len: 30,
        action_len: 9,
        codebook_len: 20,
        plan_len: 16,
        word_dim: 384,
        words_len: 28,
        layers: 4,
        heads: 4,
        head_dim: 32,
        hidden: 512,
        low_layers: 6,
        horizon: 20,
        steps: 280,
    };

    /// Returns the number of elements of a token.
    pub fn width(&self) -> usize {
        self.heads * self.head_dim
    }
}

/// Dense layer with weights `w`, `[k, n]` row-major.
#[derive(Clone)]
pub struct Dense {
    pub k: usize,
    pub n: usize,
    pub w: Vec<f32>,
    pub b: Vec<f32>,
}

impl Dense {
    fn new(random: &mut Random, k: usize, n: usize) -> Self {
        Self {
            k,
            n,
            w: random.vec(k * n, 1.7 / (k as f32).sqrt()),
            b: random.vec(n, 0.1),
        }
    }

    fn apply(&self, x: &[f64]) -> Vec<f64> {
        assert_eq!(x.len(), self.k);
        (0..self.n)
            .map(|j| {
                f64::from(self.b[j])
                    + (0..self.k)
                        .map(|i| x[i] * f64::from(self.w[i * self.n + j]))
                        .sum::<f64>()
            })
            .collect()
    }
}

/// Scale and shift of a layer norm.
#[derive(Clone)]
pub struct Norm {
    pub gamma: Vec<f32>,
    pub beta: Vec<f32>,
}

impl Norm {
    fn new(random: &mut Random, width: usize) -> Self {
        Self {
            gamma: random.vec(width, 0.3).iter().map(|g| 1.0 + g).collect(),
            beta: random.vec(width, 0.1),
        }
    }

    fn apply(&self, x: &[f64]) -> Vec<f64> {
        let n = x.len() as f64;
        let mean = x.iter().sum::<f64>() / n;
        let variance = x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n;
        let scale = 1.0 / (variance + f64::from(EPS)).sqrt();
        (0..x.len())
            .map(|i| (x[i] - mean) * scale * f64::from(self.gamma[i]) + f64::from(self.beta[i]))
            .collect()
    }
}

/// Constant added to the variance of every layer norm.
pub const EPS: f32 = 1e-5;

/// Slope of the low level's activation.
pub const ALPHA: f32 = 0.2;

/// One transformer layer.
#[derive(Clone)]
pub struct Layer {
    pub norm1: Norm,
    pub qkv: Dense,
    pub out: Dense,
    pub norm2: Norm,
    pub up: Dense,
    pub down: Dense,
}

/// Weights of a policy.
#[derive(Clone)]
pub struct Model {
    pub spec: Spec,
    pub embed_words: Dense,
    pub embed_observation: Dense,
    pub embed_action: Dense,
    pub timesteps: Vec<f32>,
    pub norm_embed: Norm,
    pub layers: Vec<Layer>,
    pub norm_final: Norm,
    pub head: Dense,
    pub codebook: Vec<f32>,
    pub low: Vec<Dense>,
    pub encoder: Dense,
    pub instructions: Vec<Vec<f32>>,
}

impl Model {
    pub fn random(spec: Spec, seed: u64) -> Self {
        let r = &mut Random(seed);
        let d = spec.width();
        let layers = (0..spec.layers)
            .map(|_| Layer {
                norm1: Norm::new(r, d),
                qkv: Dense::new(r, d, 3 * d),
                out: Dense::new(r, d, d),
                norm2: Norm::new(r, d),
                up: Dense::new(r, d, spec.hidden),
                down: Dense::new(r, spec.hidden, d),
            })
            .collect();
        let mut sizes = vec![spec.observation_len + spec.plan_len];
        sizes.extend(vec![d; spec.low_layers - 1]);
        sizes.push(spec.action_len);
        Self {
            spec,
            embed_words: Dense::new(r, spec.word_dim, d),
            embed_observation: Dense::new(r, spec.observation_len, d),
            embed_action: Dense::new(r, spec.action_len, d),
            timesteps: r.vec(spec.steps * d, 0.5),
            norm_embed: Norm::new(r, d),
            layers,
            norm_final: Norm::new(r, d),
            head: Dense::new(r, d, spec.codebook_len),
            codebook: r.vec(spec.codebook_len * spec.plan_len, 1.0),
            low: sizes
                .windows(2)
                .map(|kn| Dense::new(r, kn[0], kn[1]))
                .collect(),
            encoder: Dense::new(
                r,
                spec.horizon * (spec.observation_len + spec.action_len),
                spec.plan_len,
            ),
            instructions: vec![
                r.vec(spec.words_len * spec.word_dim, 1.0),
                r.vec((spec.words_len - 1) * spec.word_dim, 1.0),
            ],
        }
    }

    fn timestep(&self, t: usize) -> impl Iterator<Item = f64> {
        let d = self.spec.width();
        self.timesteps[t * d..(t + 1) * d]
            .iter()
            .copied()
            .map(f64::from)
    }

    /// Computes the logits at `s_t`: `x = LN([w_1..w_L, s_0, a_0, .., s_t])`, then the layers with
    /// a causal mask, then the head.
    pub fn logits(
        &self,
        words: &[f32],
        observations: &[Vec<f32>],
        actions: &[Vec<f32>],
    ) -> Vec<f64> {
        let wide = |x: &[f32]| x.iter().copied().map(f64::from).collect::<Vec<_>>();
        let placed = |x: Vec<f64>, t| {
            x.into_iter()
                .zip(self.timestep(t))
                .map(|(x, e)| x + e)
                .collect::<Vec<_>>()
        };
        let mut x: Vec<Vec<f64>> = words
            .chunks(self.spec.word_dim)
            .map(|word| self.embed_words.apply(&wide(word)))
            .collect();
        for (t, observation) in observations.iter().enumerate() {
            x.push(placed(self.embed_observation.apply(&wide(observation)), t));
            if t + 1 < observations.len() {
                x.push(placed(self.embed_action.apply(&wide(&actions[t])), t));
            }
        }
        let mut x: Vec<Vec<f64>> = x.iter().map(|x| self.norm_embed.apply(x)).collect();
        for layer in &self.layers {
            let normed: Vec<_> = x.iter().map(|x| layer.norm1.apply(x)).collect();
            let qkv: Vec<_> = normed.iter().map(|x| layer.qkv.apply(x)).collect();
            for (i, x) in x.iter_mut().enumerate() {
                add(x, &layer.out.apply(&self.attend(&qkv[..=i])));
                let hidden: Vec<_> = layer
                    .up
                    .apply(&layer.norm2.apply(x))
                    .iter()
                    .map(|x| x.max(0.0))
                    .collect();
                add(x, &layer.down.apply(&hidden));
            }
        }
        self.head
            .apply(&self.norm_final.apply(x.last().expect("there is a token")))
    }

    /// Computes the attention of the last token to all of them.
    fn attend(&self, qkv: &[Vec<f64>]) -> Vec<f64> {
        let (d, head_dim) = (self.spec.width(), self.spec.head_dim);
        let q = &qkv.last().expect("there is a token")[..d];
        let mut y = Vec::new();
        for first in (0..d).step_by(head_dim) {
            let scores = qkv.iter().map(|row| {
                let dot: f64 = (first..first + head_dim).map(|c| q[c] * row[d + c]).sum();
                (dot / (head_dim as f64).sqrt()).exp()
            });
            let scores: Vec<f64> = scores.collect();
            let total: f64 = scores.iter().sum();
            for c in first..first + head_dim {
                y.push(
                    scores
                        .iter()
                        .zip(qkv)
                        .map(|(p, row)| p / total * row[2 * d + c])
                        .sum(),
                );
            }
        }
        y
    }

    /// Returns the codebook entry of an index.
    pub fn plan(&self, index: usize) -> &[f32] {
        &self.codebook[index * self.spec.plan_len..(index + 1) * self.spec.plan_len]
    }

    /// Computes the action `a = MLP([s; z])`, clipped to -1..1.
    pub fn act(&self, observation: &[f32], plan: usize) -> Vec<f64> {
        let mut x: Vec<f64> = observation
            .iter()
            .chain(self.plan(plan))
            .copied()
            .map(f64::from)
            .collect();
        for (i, layer) in self.low.iter().enumerate() {
            x = layer.apply(&x);
            if i + 1 < self.low.len() {
                for x in &mut x {
                    *x = if *x < 0.0 { *x * f64::from(ALPHA) } else { *x };
                }
            }
        }
        x.iter().map(|x| x.clamp(-1.0, 1.0)).collect()
    }

    /// Returns the codebook entry nearest to the output of a linear encoder on one horizon.
    pub fn encode(&self, observations: &[f32], actions: &[f32]) -> usize {
        let x: Vec<f64> = observations
            .iter()
            .chain(actions)
            .copied()
            .map(f64::from)
            .collect();
        let latent = self.encoder.apply(&x);
        let distance = |index: usize| {
            self.plan(index)
                .iter()
                .zip(&latent)
                .map(|(c, x)| (f64::from(*c) - x).powi(2))
                .sum::<f64>()
        };
        (0..self.spec.codebook_len)
            .min_by(|&a, &b| distance(a).total_cmp(&distance(b)))
            .expect("the codebook has entries")
    }
}

fn add(x: &mut [f64], y: &[f64]) {
    x.iter_mut().zip(y).for_each(|(x, y)| *x += y);
}
