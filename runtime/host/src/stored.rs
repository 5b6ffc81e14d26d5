//! Names the storage formats of an image's weights and KV caches.

use lads_core::Policy;
use lads_image::Tables;
use lads_image::op::{CacheFormat, Op, WeightFormat};

/// Names the formats that a policy's programs read, for example `f16 and f32 weights, f16 cache`; a
/// policy without dense layers or without a cache names none of them.
pub fn stored(policy: &Policy<'_>) -> String {
    // Opening the policy has read the same tables.
    let Ok(tables) = Tables::new(policy.image()) else {
        return String::new();
    };
    let ops: Vec<Op> = (0..tables.entries_len())
        .filter_map(|i| tables.entry(i))
        .flat_map(|entry| {
            let ops = tables.ops(&entry).iter();
            ops.filter_map(Op::decode)
        })
        .collect();
    let weights = WeightFormat::ALL.into_iter().filter(|&format| {
        let stores = |op: &Op| matches!(op, Op::Linear(op) if op.format == format);
        ops.iter().any(stores)
    });
    let caches = CacheFormat::ALL.into_iter().filter(|&format| {
        let stores = |op: &Op| matches!(op, Op::Attention(op) if op.format == format);
        ops.iter().any(stores)
    });
    let all = [
        named(weights.map(WeightFormat::name).collect(), "weights"),
        named(caches.map(CacheFormat::name).collect(), "cache"),
    ];
    all.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

fn named(mut formats: Vec<&str>, what: &str) -> Option<String> {
    formats.sort_unstable();
    (!formats.is_empty()).then(|| format!("{} {what}", formats.join(" and ")))
}
