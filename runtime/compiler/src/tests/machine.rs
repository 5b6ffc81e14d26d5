//! A plain interpreter of ops, independent of the core's executor: loops, sums in `f64`.

use lads_image::op::{
    Activation, INT_SLOTS, Op, Operand, Pair, Picture, Place, Space, Span, UnaryKind, WeightSpan,
    Window,
};
use lads_kernels::{PANEL, reference};

use crate::graph::{Kind, Unary};
use crate::plan::Placed;

pub struct Machine<'w> {
    weights: &'w [f32],
    arena: Vec<f32>,
    pub cache: Vec<f32>,
    ints: [i64; INT_SLOTS],
}

/// Returns the offsets of all elements of a strided layout, in order.
fn offsets(dims: [u32; 4], strides: [u32; 4]) -> Vec<usize> {
    let (dims, strides) = (dims.map(|x| x as usize), strides.map(|x| x as usize));
    (0..dims.iter().product())
        .map(|i| reference::offset(dims, strides, i))
        .collect()
}

fn pair(pair: Pair) -> [usize; 2] {
    [pair.rows, pair.cols].map(usize::from)
}

fn strides(picture: Picture) -> [usize; 2] {
    [picture.row, picture.pixel].map(|stride| stride as usize)
}

fn sweep(window: Window, x: Picture, y: Picture) -> lads_kernels::Sweep {
    lads_kernels::Sweep {
        out: pair(window.out),
        kernel: pair(window.kernel),
        stride: pair(window.stride),
        dilation: pair(window.dilation),
        x_strides: strides(x),
        y_strides: strides(y),
    }
}

fn element(activation: UnaryKind, alpha: f32, x: f32) -> f32 {
    let unary = Unary {
        kind: Kind(activation),
        alpha: alpha.to_bits(),
    };
    crate::graph::apply(unary, x)
}

impl<'w> Machine<'w> {
    /// Makes an arena full of NaN, so that an unwritten element is noticed.
    pub fn new(program: &Placed, weights: &'w [f32], cache: Vec<f32>) -> Self {
        Self {
            weights,
            arena: vec![f32::NAN; program.arena_len as usize],
            cache,
            ints: [-1; INT_SLOTS],
        }
    }

    pub fn set(&mut self, program: &Placed, name: &str, values: &[f32]) {
        for (found, place) in &program.inputs {
            match *place {
                Place::Span(span) if found == name => {
                    assert_eq!(span.len as usize, values.len());
                    self.arena[span.offset as usize..][..values.len()].copy_from_slice(values);
                }
                Place::Int(slot) if found == name => {
                    self.ints[usize::from(slot.0)] = values[0] as i64;
                }
                _ => {}
            }
        }
    }

    pub fn output(&self, program: &Placed, name: &str) -> Vec<f32> {
        let &(_, place) = program
            .outputs
            .iter()
            .find(|(found, _)| found == name)
            .expect("an output");
        match place {
            Place::Span(span) => self.get(span).to_vec(),
            Place::Int(slot) => vec![self.ints[usize::from(slot.0)] as f32],
        }
    }

    fn get(&self, span: Span) -> &[f32] {
        &self.arena[span.offset as usize..][..span.len as usize]
    }

    fn weights(&self, span: WeightSpan) -> &[f32] {
        &self.weights[span.offset as usize..][..span.len as usize]
    }

    fn operand(&self, operand: Operand) -> Vec<f32> {
        let memory = if operand.space == Space::Arena {
            &self.arena[..]
        } else {
            self.weights
        };
        memory[operand.offset as usize..][..operand.len as usize].to_vec()
    }

    fn put(&mut self, span: Span, values: &[f32]) {
        assert_eq!(span.len as usize, values.len());
        self.arena[span.offset as usize..][..values.len()].copy_from_slice(values);
    }

    pub fn run(&mut self, program: &Placed, past: usize) {
        for op in &program.ops {
            self.op(op, past);
        }
    }

    #[expect(clippy::too_many_lines, reason = "one arm per op, nothing shared")]
    fn op(&mut self, op: &Op, past: usize) {
        match op {
            Op::Linear(op) => {
                let (x, w) = (self.get(op.x).to_vec(), self.weights(op.w));
                let (m, k, n) = (op.m as usize, op.k as usize, op.n as usize);
                let mut y = vec![];
                for i in 0..m * n {
                    let (row, col) = (i / n, i % n);
                    let first = col / PANEL * PANEL;
                    let wide = (n - first).next_multiple_of(16).min(PANEL);
                    let panel = &w[first * k..];
                    let products = (0..k).map(|l| {
                        f64::from(x[row * k + l]) * f64::from(panel[l * wide + col % PANEL])
                    });
                    let sum = products.sum::<f64>()
                        + op.bias
                            .map_or(0.0, |bias| f64::from(self.weights(bias)[col]));
                    let sum = match op.activation {
                        Activation::None => sum as f32,
                        Activation::Relu => element(UnaryKind::Relu, 0.0, sum as f32),
                        Activation::LeakyRelu(alpha) => {
                            element(UnaryKind::LeakyRelu, alpha, sum as f32)
                        }
                        Activation::Clipped(bound) => {
                            match element(UnaryKind::Relu, 0.0, sum as f32) {
                                sum if sum > bound => bound,
                                sum => sum,
                            }
                        }
                        Activation::Tanh => element(UnaryKind::Tanh, 0.0, sum as f32),
                        Activation::Sigmoid => element(UnaryKind::Sigmoid, 0.0, sum as f32),
                        Activation::Elu(alpha) => element(UnaryKind::Elu, alpha, sum as f32),
                        Activation::Softplus => element(UnaryKind::Softplus, 0.0, sum as f32),
                        Activation::Mish => element(UnaryKind::Mish, 0.0, sum as f32),
                    };
                    y.push(if op.accumulate {
                        self.get(op.y)[i] + sum
                    } else {
                        sum
                    });
                }
                self.put(op.y, &y);
            }
            Op::LayerNorm(op) => {
                let mut y = vec![0.0; op.y.len as usize];
                reference::layer_norm(
                    self.get(op.x),
                    self.weights(op.gamma),
                    self.weights(op.beta),
                    op.eps,
                    &mut y,
                );
                self.put(op.y, &y);
            }
            Op::Attention(op) => self.attention(op, past),
            Op::Binary(op) => {
                let (a, b) = (self.operand(op.a), self.operand(op.b));
                let pairs = offsets(op.dims, op.a_strides)
                    .into_iter()
                    .zip(offsets(op.dims, op.b_strides));
                let kind = lads_kernels_kind(op.kind);
                let y: Vec<f32> = pairs
                    .map(|(i, j)| reference::binary(kind, a[i], b[j]))
                    .collect();
                self.put(op.y, &y);
            }
            Op::Unary(op) => {
                let y: Vec<f32> = self
                    .operand(op.x)
                    .iter()
                    .map(|&x| element(op.kind, op.alpha, x))
                    .collect();
                self.put(op.y, &y);
            }
            Op::Softmax(op) => {
                let mut y = vec![0.0; op.y.len as usize];
                reference::softmax(self.get(op.x), op.cols as usize, &mut y);
                self.put(op.y, &y);
            }
            Op::Reduce(op) => {
                use lads_image::op::ReduceKind;
                let x = self.operand(op.x);
                let (len, inner) = (op.axis as usize, op.inner as usize);
                let mut y = vec![];
                for i in 0..op.y.len as usize {
                    let row =
                        (0..len).map(|a| f64::from(x[(i / inner * len + a) * inner + i % inner]));
                    y.push(match op.kind {
                        ReduceKind::Sum => row.sum::<f64>(),
                        ReduceKind::Mean => row.sum::<f64>() / len as f64,
                        ReduceKind::Max => row.fold(f64::MIN, f64::max),
                        ReduceKind::Min => row.fold(f64::MAX, f64::min),
                        ReduceKind::Prod => row.product::<f64>(),
                    } as f32);
                }
                self.put(op.y, &y);
            }
            Op::MatMul(op) => {
                let (a, b) = (self.operand(op.a), self.operand(op.b));
                let at = |strides: [u32; 3], i: [u32; 3]| {
                    (0..3).map(|d| (strides[d] * i[d]) as usize).sum::<usize>()
                };
                let mut y = vec![];
                for batch in 0..op.batch {
                    for (i, j) in (0..op.m).flat_map(|i| (0..op.n).map(move |j| (i, j))) {
                        let product = |l| {
                            f64::from(a[at(op.a_strides, [batch, i, l])])
                                * f64::from(b[at(op.b_strides, [batch, l, j])])
                        };
                        y.push((0..op.k).map(product).sum::<f64>() as f32);
                    }
                }
                self.put(op.y, &y);
            }
            Op::GatherRow(op) => {
                let row = (self.ints[usize::from(op.index.0)] + i64::from(op.shift)) as usize;
                assert!(row < op.rows as usize);
                let len = op.row_len as usize;
                let y = self.operand(op.table)[row * len..][..len].to_vec();
                self.put(op.y, &y);
            }
            Op::Copy(op) => {
                let x = self.operand(op.x);
                for (from, to) in offsets(op.dims, op.x_strides)
                    .into_iter()
                    .zip(offsets(op.dims, op.y_strides))
                {
                    self.arena[op.y.offset as usize + to] = x[from];
                }
            }
            Op::Conv(op) => {
                let [kernel_rows, kernel_cols] = pair(op.window.kernel);
                let (k, n) = (kernel_rows * kernel_cols * op.c as usize, op.n as usize);
                let packed = self.weights(op.w);
                let w: Vec<f32> = (0..k * n)
                    .map(|i| packed[(i % n / 16 * k + i / n) * 16 + i % n % 16])
                    .collect();
                let mut y = self.get(op.y.at).to_vec();
                let what = (op.activation, op.accumulate);
                let weights = (&w[..], self.weights(op.bias));
                let x = self.get(op.x.at);
                reference::conv(&sweep(op.window, op.x, op.y), weights, what, x, &mut y);
                self.put(op.y.at, &y);
            }
            Op::Depthwise(op) => {
                let c = op.c as usize;
                let packed = self.weights(op.w).chunks(c.next_multiple_of(16));
                let w: Vec<f32> = packed.flat_map(|row| &row[..c]).copied().collect();
                let mut y = self.get(op.y.at).to_vec();
                let weights = (&w[..], self.weights(op.bias));
                let x = self.get(op.x.at);
                reference::depthwise(
                    &sweep(op.window, op.x, op.y),
                    weights,
                    op.activation,
                    x,
                    &mut y,
                );
                self.put(op.y.at, &y);
            }
            Op::ImageIntegers(_) | Op::IntegerConv(_) => {
                panic!("programs of these tests have 32-bit floats")
            }
            Op::Border(op) => {
                let ([top, left], [rows, cols]) = (pair(op.before), pair(op.inside));
                let [_, right] = pair(op.after);
                let (c, line) = (op.c as usize, left + cols + right);
                for i in 0..op.y.len as usize {
                    let (row, col) = (i / c / line, i / c % line);
                    let inside =
                        (top..top + rows).contains(&row) && (left..left + cols).contains(&col);
                    if !inside {
                        let value = op.value.map_or(0.0, |value| self.weights(value)[i % c]);
                        self.arena[op.y.offset as usize + i] = value;
                    }
                }
            }
            Op::Pool(op) => {
                let pool = lads_kernels::Pool {
                    kind: op.kind,
                    size: pair(op.size),
                    out: pair(op.window.out),
                    c: op.c as usize,
                    kernel: pair(op.window.kernel),
                    stride: pair(op.window.stride),
                    dilation: pair(op.window.dilation),
                    before: pair(op.before),
                    after: pair(op.after),
                    x_strides: strides(op.x),
                    y_strides: strides(op.y),
                };
                let mut y = self.get(op.y.at).to_vec();
                reference::pool(&pool, self.get(op.x.at), &mut y);
                self.put(op.y.at, &y);
            }
            Op::Resize(op) => {
                let resize = lads_kernels::Resize {
                    size: pair(op.size),
                    c: op.c as usize,
                    rows: self.weights(op.rows),
                    cols: self.weights(op.cols),
                    x_strides: strides(op.x),
                    y_strides: strides(op.y),
                };
                let mut y = self.get(op.y.at).to_vec();
                reference::resize(&resize, self.get(op.x.at), &mut y);
                self.put(op.y.at, &y);
            }
            Op::ToIndex(op) => self.ints[usize::from(op.out.0)] = self.get(op.x)[0] as i64,
            Op::FromIndex(op) => {
                let number = self.ints[usize::from(op.index.0)] + i64::from(op.shift);
                self.put(op.y, &[number as f32]);
            }
            Op::ArgMin(op) => {
                self.ints[usize::from(op.out.0)] = first_best(self.get(op.x), |a, b| a < b);
            }
            Op::ArgMax(op) => {
                self.ints[usize::from(op.out.0)] = first_best(self.get(op.x), |a, b| a > b);
            }
        }
    }

    fn attention(&mut self, op: &lads_image::op::Attention, past: usize) {
        let width = (op.heads * op.head_dim) as usize;
        for i in 0..op.tokens as usize {
            for col in 0..width {
                let key = self.get(op.k)[i * op.k_stride as usize + col];
                let value = self.get(op.v)[i * op.v_stride as usize + col];
                let row = past + i;
                self.cache[op.cache_k.offset as usize + reference::key(width, row, col)] = key;
                self.cache[op.cache_v.offset as usize + row * width + col] = value;
            }
        }
        if op.queries == 0 {
            return;
        }
        // Whatever was in the scratch memory is gone.
        self.arena[op.scratch.offset as usize..][..op.scratch.len as usize].fill(f32::NAN);
        let attention = lads_kernels::Attention {
            q_stride: op.q_stride as usize,
            heads: op.heads as usize,
            head_dim: op.head_dim as usize,
            visible: past + (op.tokens - op.queries) as usize + 1,
            scale: op.scale,
            cache: lads_kernels::Cache::F32 {
                keys: &self.cache[op.cache_k.offset as usize..],
                values: &self.cache[op.cache_v.offset as usize..],
            },
        };
        let mut y = vec![0.0; op.y.len as usize];
        reference::attention(&attention, self.get(op.q), &mut y);
        self.put(op.y, &y);
    }
}

fn lads_kernels_kind(kind: lads_image::op::BinaryKind) -> lads_kernels::BinaryKind {
    use lads_image::op::BinaryKind as Core;
    use lads_kernels::BinaryKind as Kernel;
    match kind {
        Core::Add => Kernel::Add,
        Core::Sub => Kernel::Sub,
        Core::Mul => Kernel::Mul,
        Core::Div => Kernel::Div,
        Core::Max => Kernel::Max,
        Core::Min => Kernel::Min,
        Core::Pow => Kernel::Pow,
        Core::Greater => Kernel::Greater,
        Core::Keep => Kernel::Keep,
    }
}

fn first_best(x: &[f32], better: impl Fn(f32, f32) -> bool) -> i64 {
    let mut best = 0;
    for (i, &value) in x.iter().enumerate() {
        if better(value, x[best]) {
            best = i;
        }
    }
    best as i64
}
