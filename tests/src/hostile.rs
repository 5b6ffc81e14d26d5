//! Hostile files: an edit script turns the small bundle, or the image made of it, into one that is almost sound, and everything that takes
//! it has to refuse it or work.
//!
//! A script is a row of edits of eight bytes: what to do, where, and with which value. Any bytes are a script, so fuzzers (`tests/fuzz`)
//! and the seeded mutator of `tests/tests/hostile.rs` drive the same functions. All panic when an invariant is broken.

mod import;

use std::sync::OnceLock;

use lads_compiler::{
    Bundle, CacheFormat, Image, Options, Storage, WeightFormat, compile, compile_with, survey,
};
use lads_core::{
    ChannelId, DType, Data, GuardConfig, GuardedController, Instruction, Policy, Tick,
};
use lads_host::Memory;
use lads_image::format::{CRC_WORD, crc32};

use crate::episode::{FOLDER, folder, kinds};
use crate::{compiled, wire};

pub use import::{BREAK, import};

/// Number of bytes of one edit.
const EDIT_BYTES: usize = 8;

/// Largest number of edits of a script that are carried out.
const MOST_EDITS: usize = 32;

/// Largest number of elements that a caller of these tests lends; a policy that wants more is not run.
const MOST_ELEMENTS: usize = 1 << 20;

/// Numbers that tend to break parsers.
const VALUES: [u64; 16] = [
    0,
    1,
    2,
    3,
    63,
    64,
    255,
    1 << 15,
    1 << 16,
    (1 << 31) - 1,
    1 << 31,
    u32::MAX as u64,
    0x7f80_0000,
    0x7fc0_0000,
    1 << 40,
    u64::MAX,
];

/// One edit of a script.
#[derive(Debug, Clone, Copy)]
pub struct Edit {
    /// Operation; each function gives it its own meaning.
    pub kind: u8,
    /// Place of the edit.
    pub place: usize,
    /// Value to write.
    pub value: u64,
}

fn script(bytes: &[u8]) -> impl Iterator<Item = Edit> {
    let (edits, _) = bytes.as_chunks::<EDIT_BYTES>();
    edits
        .iter()
        .take(MOST_EDITS)
        .map(|&[kind, p0, p1, p2, chosen, v0, v1, v2]| Edit {
            kind,
            place: u32::from_le_bytes([p0, p1, p2, 0]) as usize,
            value: match VALUES.get(usize::from(chosen)) {
                Some(&value) => value,
                None => u64::from(u32::from_le_bytes([v0, v1, v2, 0])),
            },
        })
}

/// The small bundle.
const TINY: &[u8] = include_bytes!("../../runtime/compiler/tests/data/tiny.onnx");

/// Returns the images that are edited: the small bundle's, exact and with weights and cache of fewer bits, and where the parity tests have
/// made them, one of every family.
fn images() -> &'static [Vec<u32>] {
    static IMAGES: OnceLock<Vec<Vec<u32>>> = OnceLock::new();
    IMAGES.get_or_init(|| {
        let words = |image: &Image| {
            let (words, _) = image.as_bytes().as_chunks::<4>();
            words.iter().map(|&word| u32::from_le_bytes(word)).collect()
        };
        let bundle = Bundle::from_bytes(TINY).expect("the bundle is sound");
        let smaller = Options {
            storage: Some(
                Storage::of_weights(WeightFormat::Int8)
                    .with_part("low_level/act", WeightFormat::F16)
                    .with_cache(CacheFormat::Int8),
            ),
            force: true,
            ..Options::default()
        };
        let halves = Options {
            storage: Some(Storage::of_weights(WeightFormat::Bf16).with_cache(CacheFormat::F16)),
            force: true,
            ..Options::default()
        };
        let mut images: Vec<Vec<u32>> = [Options::exact(), smaller, halves]
            .iter()
            .map(|options| words(&compile_with(&bundle, options).expect("it compiles")))
            .collect();
        if std::env::var_os(FOLDER).is_some() {
            let family = |kind| words(&compiled(&folder().join(format!("{kind}.onnx"))));
            images.extend(kinds().into_iter().map(family));
        }
        images
    })
}

/// Edits an image, gives it the right checksum, opens it, and drives it.
///
/// # Panics
///
/// When anything panics, or an action is not finite.
pub fn image(edits: &[u8]) {
    let images = images();
    let mut words = images[edits.len() % images.len()].clone();
    let mut len = words.len() * 4;
    for Edit { kind, place, value } in script(edits) {
        // The tables come first: most edits go there.
        let most = if kind & 0x80 == 0 {
            4096.min(words.len())
        } else {
            words.len()
        };
        let other = words[(value as usize) % most];
        let word = &mut words[place % most];
        match kind % 8 {
            0..=2 => *word = value as u32,
            3 => *word = word.wrapping_add((value as u32 & 0xff).wrapping_sub(128)),
            4 => *word ^= 1 << (value % 32),
            5 => *word = other,
            6 => *word = word.wrapping_mul(value as u32),
            _ => len = len.min((place + 1).max(value as usize)),
        }
    }
    let mut bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
    bytes.truncate(len);
    if bytes.len() >= (CRC_WORD + 1) * 4 {
        let crc = crc32(&bytes);
        bytes[CRC_WORD * 4..][..4].copy_from_slice(&crc.to_le_bytes());
    }
    open_and_drive(&bytes);
}

/// Largest number of multiply-adds of a step that these tests wait for; a policy that wants more is refused when it is opened.
const MOST_WORK: u64 = 1 << 24;

/// Values of an observation channel, in memory of their own.
enum Values {
    F32(Vec<f32>),
    U8(Vec<u8>),
    I32(Vec<i32>),
}

impl Values {
    fn data(&self) -> Data<'_> {
        match self {
            Self::F32(values) => Data::F32(values),
            Self::U8(values) => Data::U8(values),
            Self::I32(values) => Data::I32(values),
        }
    }
}

/// Opens an image and drives what opens through a guard: the self-test, then steps of two instructions.
///
/// # Panics
///
/// When anything panics, or an action is outside the limits.
pub fn open_and_drive(bytes: &[u8]) {
    drive(bytes, true, 12);
}

/// Opens an image and runs what opens for a few steps, as [`open_and_drive`] does, without the self-test: for very many images.
///
/// # Panics
///
/// When anything panics, or an action is outside the limits.
pub fn open_and_step(bytes: &[u8]) {
    drive(bytes, false, 3);
}

fn drive(bytes: &[u8], tested: bool, steps: u64) {
    // In memory that is aligned as images have to be, and not a byte longer.
    let mut aligned = vec![0_u64; bytes.len().div_ceil(8)];
    for (to, from) in aligned.iter_mut().zip(bytes.chunks(8)) {
        let mut word = [0; 8];
        word[..from.len()].copy_from_slice(from);
        *to = u64::from_ne_bytes(word);
    }
    let aligned: &[u8] = bytemuck::cast_slice(&aligned);
    let Ok(policy) = Policy::new_within(&aligned[..bytes.len()], MOST_WORK) else {
        return;
    };
    policy.checksum_matches();
    let contract = policy.contract();
    let observed = contract.observations().map(|channel| channel.len());
    let elements = observed.fold(contract.action_len(), usize::saturating_add);
    let lens = [policy.arena_len(), policy.state_len(), elements];
    if lens.iter().any(|&len| len > MOST_ELEMENTS) {
        let bytes = lens[0].saturating_add(lens[1]).saturating_mul(4);
        let refused = bytes > Policy::MEMORY_LIMIT;
        assert!(!refused || Memory::of(&policy).is_err(), "{bytes}");
        return;
    }
    let mut memory = Memory::of(&policy).expect("so little is there");
    let mut guard = vec![0.0; GuardedController::memory_len(&policy)];
    let controller = memory
        .controller(&policy)
        .expect("there is as much as it asks for");
    let mut guarded = GuardedController::new(controller, &GuardConfig::default(), &mut guard)
        .expect("the contract's own limits are sound");
    if tested {
        let _ = guarded.self_test();
    }
    guarded.arm_untested();
    let middle = |min: f32, max: f32| min / 2.0 + max / 2.0;
    let observations: Vec<(ChannelId, Values)> = contract
        .observations()
        .map(|channel| {
            let middles = channel
                .limits()
                .map(|limits| middle(limits.min, limits.max));
            let values = match channel.dtype() {
                DType::F32 => Values::F32(middles.collect()),
                DType::U8 => Values::U8(middles.map(|x| x as u8).collect()),
                DType::I32 => Values::I32(middles.map(|x| x as i32).collect()),
            };
            (channel.id(), values)
        })
        .collect();
    let inputs: Vec<(ChannelId, Data)> = observations
        .iter()
        .map(|(id, values)| (*id, values.data()))
        .collect();
    let limits: Vec<_> = contract.action_limits().collect();
    let mut action = vec![0.0; contract.action_len()];
    for number in 0..2 {
        let _ = guarded.set_instruction(Instruction::Id(number));
        for timestamp in 0..steps {
            let tick = Tick {
                timestamp,
                missed: 0,
            };
            let _ = guarded.step_with(&inputs, Some(tick).filter(|_| number == 0), &mut action);
            let inside = action
                .iter()
                .zip(&limits)
                .all(|(x, e)| x.is_finite() && e.clamp(*x) == *x);
            assert!(inside, "{action:?}");
            guarded.resume();
        }
    }
}

/// Returns the bundles that are edited: the small one, and where the parity tests have made it, one whose policy sees images.
fn trees() -> &'static [Vec<wire::Field>] {
    static TREES: OnceLock<Vec<Vec<wire::Field>>> = OnceLock::new();
    TREES.get_or_init(|| {
        let parse = |bytes: &[u8]| wire::parse(bytes).expect("a bundle is a message");
        let mut trees = vec![parse(TINY)];
        if std::env::var_os(FOLDER).is_some() {
            let path = folder().join("images.onnx");
            trees.push(parse(&std::fs::read(path).expect("it can be read")));
        }
        trees
    })
}

/// Edits the protocol buffers of a bundle, opens it, compiles it, and drives the image.
///
/// # Panics
///
/// When anything panics, an error is not one line, or an image that was made does not open.
pub fn bundle(edits: &[u8]) {
    let trees = trees();
    let mut tree = trees[edits.len() % trees.len()].clone();
    for edit in script(edits) {
        wire::edit(&mut tree, edit);
    }
    let bytes = wire::bytes(&tree);
    let refused = match Bundle::from_bytes(&bytes) {
        Err(error) => error.to_string(),
        Ok(bundle) => match compile(&bundle) {
            Err(error) => error.to_string(),
            Ok(image) => {
                Policy::new_checked(image.as_bytes()).expect("an image that was made opens");
                return open_and_drive(image.as_bytes());
            }
        },
    };
    assert!(
        !refused.is_empty() && !refused.contains('\n'),
        "{refused:?}"
    );
    // What `lads inspect` tells of it.
    if let Ok(found) = survey(&bytes) {
        let mut told = found.missing.contract.iter();
        assert!(told.all(|fault| !fault.needed.contains('\n')));
    }
}
