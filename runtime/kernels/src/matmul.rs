//! Products of two activations, batched and strided.

/// Batched matrix product `y[b, i, j] = sum over l of a[b, i, l] * b[b, l, j]`, each sum in the
/// order of `l`.
#[derive(Debug, Clone, Copy)]
pub struct MatMul {
    /// Number of independent products.
    pub batch: usize,
    /// Number of rows.
    pub m: usize,
    /// Inner dimension.
    pub k: usize,
    /// Number of columns.
    pub n: usize,
    /// Strides of `a` over batch, `m` and `k`.
    pub a_strides: [usize; 3],
    /// Strides of `b` over batch, `k` and `n`.
    pub b_strides: [usize; 3],
}

impl MatMul {
    /// Computes `y`, `[batch, m, n]`, contiguous.
    pub fn run(&self, a: &[f32], b: &[f32], y: &mut [f32]) {
        let [a_batch, a_row, a_col] = self.a_strides;
        let [b_batch, b_row, b_col] = self.b_strides;
        let mut ys = y.chunks_exact_mut(self.n.max(1));
        for batch in 0..self.batch {
            let b = b.get(batch * b_batch..).unwrap_or(&[]);
            for row in 0..self.m {
                let a = a.get(batch * a_batch + row * a_row..).unwrap_or(&[]);
                let Some(y) = ys.next() else { return };
                y.fill(0.0);
                for l in 0..self.k {
                    let a = a.get(l * a_col).copied().unwrap_or(0.0);
                    add_row(y, a, b.get(l * b_row..).unwrap_or(&[]), b_col);
                }
            }
        }
    }
}

/// Computes `y[j] += a * b[j * stride]`.
#[inline(always)]
fn add_row(y: &mut [f32], a: f32, b: &[f32], stride: usize) {
    match (stride, b.first()) {
        (0, Some(&b)) => {
            for y in y {
                *y += a * b;
            }
        }
        (1, _) => {
            for (y, &b) in y.iter_mut().zip(b) {
                *y += a * b;
            }
        }
        _ => {
            for (y, &b) in y.iter_mut().zip(b.iter().step_by(stride.max(1))) {
                *y += a * b;
            }
        }
    }
}
