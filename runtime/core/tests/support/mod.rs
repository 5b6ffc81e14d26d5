//! Policies for the tests of this crate: a small LADS policy with random weights, written naively in `f64` straight from its
//! definition and assembled by hand from ops, and the smallest image of each shape that a schedule can have.
#![allow(dead_code, reason = "each test binary uses its own part")]

pub mod assemble;
pub mod draft;
pub mod guarding;
pub mod layout;
#[path = "../../../image/tests/support/model.rs"]
pub mod model;
#[path = "../../../image/tests/support/assemble.rs"]
pub mod programs;
#[path = "../../../image/tests/support/random.rs"]
pub mod random;
pub mod shapes;
pub mod writer;

use lads_core::{ChannelId, Controller, DType, Data, Instruction, Policy, PolicyError, Workspace};

#[allow(unused_imports, reason = "as above")]
pub use model::{Model, Spec};
pub use random::Random;

/// An image in memory with the alignment that images need.
#[derive(Clone)]
pub struct Image(pub Vec<u32>);

impl Image {
    pub fn bytes(&self) -> &[u8] {
        bytemuck::cast_slice(&self.0)
    }

    pub fn policy(&self) -> Policy<'_> {
        Policy::new_checked(self.bytes()).expect("the image is sound")
    }

    /// Returns why the image is refused, if it is.
    pub fn refused(&self) -> Option<PolicyError> {
        Policy::new_checked(self.bytes()).err()
    }
}

/// The memory of one controller.
pub struct Memory {
    pub arena: Vec<f32>,
    pub state: Vec<f32>,
}

impl Memory {
    /// Makes as much memory as the policy needs, filled with garbage that must not matter.
    pub fn for_policy(policy: &Policy) -> Self {
        Self {
            arena: vec![f32::NAN; policy.arena_len()],
            state: vec![f32::NAN; policy.state_len()],
        }
    }

    pub fn controller<'a, 'm>(&'m mut self, policy: &Policy<'a>) -> Controller<'a, 'm> {
        let workspace =
            Workspace::new(policy, &mut self.arena, &mut self.state).expect("the memory suffices");
        Controller::new(*policy, workspace)
    }
}

/// Runs `f` on a new controller, with instruction 0 if the policy takes one.
pub fn with_controller<T>(image: &Image, f: impl FnOnce(&mut Controller) -> T) -> T {
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    if policy.contract().instruction_count() > 0 {
        controller
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
    }
    f(&mut controller)
}

/// The values of a channel.
#[derive(Debug, Clone)]
pub enum Values {
    F32(Vec<f32>),
    U8(Vec<u8>),
    I32(Vec<i32>),
}

impl Values {
    pub fn data(&self) -> Data<'_> {
        match self {
            Self::F32(values) => Data::F32(values),
            Self::U8(values) => Data::U8(values),
            Self::I32(values) => Data::I32(values),
        }
    }

    /// Returns the values in the words that an image stores.
    pub fn words(&self) -> Vec<u32> {
        match self {
            Self::F32(values) => values.iter().map(|x| x.to_bits()).collect(),
            Self::I32(values) => values.iter().map(|x| x.cast_unsigned()).collect(),
            Self::U8(values) => values
                .chunks(4)
                .map(|four| {
                    let mut bytes = [0; 4];
                    bytes[..four.len()].copy_from_slice(four);
                    u32::from_le_bytes(bytes)
                })
                .collect(),
        }
    }
}

/// Returns random values inside the limits of every observation channel, no larger than one where
/// the limits are wider.
pub fn observe(policy: &Policy, random: &mut Random) -> Vec<(ChannelId, Values)> {
    let values = policy.contract().observations().map(|channel| {
        let floats = channel.limits().map(|limits| match channel.dtype() {
            DType::F32 => limits.clamp(random.next()),
            _ => limits.min + (limits.max - limits.min) * (random.next() + 1.0) / 2.0,
        });
        let values = match channel.dtype() {
            DType::F32 => Values::F32(floats.collect()),
            DType::U8 => Values::U8(floats.map(|x| x as u8).collect()),
            DType::I32 => Values::I32(floats.map(|x| x as i32).collect()),
        };
        (channel.id(), values)
    });
    values.collect()
}

/// Borrows values in the form that a call takes.
pub fn given(values: &[(ChannelId, Values)]) -> Vec<(ChannelId, Data<'_>)> {
    values.iter().map(|(id, x)| (*id, x.data())).collect()
}

/// Returns the softmax-weighted sum of rows, the last one being the query and each its own key and
/// value.
pub fn attend(rows: &[Vec<f64>]) -> Vec<f64> {
    let query = rows.last().expect("there is a row");
    let scale = 1.0 / (query.len() as f64).sqrt();
    let weights = rows.iter().map(|row| {
        let dot: f64 = row.iter().zip(query).map(|(a, b)| a * b).sum();
        (dot * scale).exp()
    });
    let weights: Vec<f64> = weights.collect();
    let total: f64 = weights.iter().sum();
    (0..query.len())
        .map(|i| {
            rows.iter()
                .zip(&weights)
                .map(|(row, p)| p / total * row[i])
                .sum()
        })
        .collect()
}

pub fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().copied().map(f64::from).collect()
}
