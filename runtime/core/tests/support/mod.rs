//! A small LADS policy for the tests of this crate: random weights, the network written naively in `f64` straight from its
//! definition, and the same network assembled by hand from ops into a program image.
#![allow(dead_code, reason = "each test binary uses its own part")]

pub mod assemble;
pub mod model;
pub mod writer;

use lads_core::{Controller, Policy, Workspace};

pub use model::{Model, Spec};

/// An image in memory that is aligned as images have to be.
#[derive(Clone)]
pub struct Image(pub Vec<u32>);

impl Image {
    pub fn bytes(&self) -> &[u8] {
        bytemuck::cast_slice(&self.0)
    }

    pub fn policy(&self) -> Policy<'_> {
        Policy::new_checked(self.bytes()).expect("the image is sound")
    }
}

/// The memory of one controller.
pub struct Memory {
    pub arena: Vec<f32>,
    pub state: Vec<f32>,
}

impl Memory {
    /// As much as the policy needs, filled with what must not matter.
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

/// A small linear congruential generator (Knuth's MMIX constants), the same on every platform.
#[derive(Clone)]
pub struct Random(pub u64);

impl Random {
    /// Uniform in -1..1.
    pub fn next(&mut self) -> f32 {
        self.0 = self
            .0
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (self.0 >> 40) as f32 / (1_u64 << 23) as f32 - 1.0
    }

    pub fn vec(&mut self, len: usize, scale: f32) -> Vec<f32> {
        (0..len).map(|_| self.next() * scale).collect()
    }
}
