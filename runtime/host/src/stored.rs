//! Names the storage formats of an image's weights and KV caches.

use lads_core::Policy;
use lads_image::Tables;
use lads_image::op::{CacheFormat, Op, WeightFormat};

/// Names the formats that a policy's programs read, for example `f16 and f32 weights, f16 cache`; a
/// policy without dense layers and convolutions or without a cache names none of them.
pub fn stored(policy: &Policy<'_>) -> String {
    let (weights, caches) = formats(policy);
    let all = [
        named(weights.into_iter().map(WeightFormat::name), "weights"),
        named(caches.into_iter().map(CacheFormat::name), "cache"),
    ];
    all.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

/// Whether a policy's weights and caches all have 32 bits, so that nothing of it was rounded.
pub fn is_exact(policy: &Policy<'_>) -> bool {
    let (weights, caches) = formats(policy);
    weights.iter().all(|&format| format == WeightFormat::F32)
        && caches.iter().all(|&format| format == CacheFormat::F32)
}

/// Returns the formats of a policy's weights and of its KV caches.
fn formats(policy: &Policy<'_>) -> (Vec<WeightFormat>, Vec<CacheFormat>) {
    // Opening the policy has read the same tables.
    let Ok(tables) = Tables::new(policy.image()) else {
        return (vec![], vec![]);
    };
    let ops: Vec<Op> = tables.every_op().collect();
    let weights = WeightFormat::ALL.into_iter().filter(|&format| {
        let stores = |op: &Op| match op {
            Op::Linear(op) => op.format == format,
            Op::IntegerConv(op) => op.format == format,
            Op::Conv(_) | Op::Depthwise(_) => format == WeightFormat::F32,
            _ => false,
        };
        ops.iter().any(stores)
    });
    let caches = CacheFormat::ALL.into_iter().filter(|&format| {
        let stores = |op: &Op| matches!(op, Op::Attention(op) if op.format == format);
        ops.iter().any(stores)
    });
    (weights.collect(), caches.collect())
}

fn named<'n>(formats: impl Iterator<Item = &'n str>, what: &str) -> Option<String> {
    let mut formats: Vec<_> = formats.collect();
    formats.sort_unstable();
    (!formats.is_empty()).then(|| format!("{} {what}", formats.join(" and ")))
}
