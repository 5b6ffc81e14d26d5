//! Dense layers over packed weights.

/// Outputs of one weight panel.
pub const PANEL: usize = 16;

/// Elements of a `[k, n]` weight matrix in panels: `ceil(n / 16) * k * 16`.
pub const fn packed_len(k: usize, n: usize) -> usize {
    n.div_ceil(PANEL) * k * PANEL
}

/// Packs `w`, `[k, n]` row-major, into panels `[ceil(n / 16)][k][16]`, the last one padded with zeros. Offline work.
///
/// # Panics
/// When `w` is not `k * n` or `out` not [`packed_len`] elements long.
pub fn pack(w: &[f32], k: usize, n: usize, out: &mut [f32]) {
    assert_eq!(w.len(), k * n, "w is [k, n]");
    assert_eq!(out.len(), packed_len(k, n), "out is packed_len(k, n)");
    out.fill(0.0);
    for (i, row) in w.chunks_exact(n.max(1)).enumerate() {
        for (p, part) in row.chunks(PANEL).enumerate() {
            let start = (p * k + i) * PANEL;
            if let Some(panel) = out.get_mut(start..start + part.len()) {
                panel.copy_from_slice(part);
            }
        }
    }
}

/// Elements of scratch that attention over a cache of `capacity` rows needs.
pub const fn attention_scratch_len(queries: usize, heads: usize, capacity: usize) -> usize {
    (if queries < 2 { queries } else { 2 }) * heads * capacity
}
