//! A small LADS policy for the tests of this crate: random weights, the network written naively in `f64` straight from its
//! definition, and the same network assembled by hand from ops into programs.
#![allow(dead_code, reason = "each test binary uses its own part")]

pub mod assemble;
pub mod model;
pub mod random;

use lads_image::op::{INT_SLOTS, Place};
use lads_image::{ExecError, Isa, Machine};

pub use assemble::{Assembled, Kind};
pub use model::{Model, Spec};
pub use random::Random;

/// Assembles a policy that is smaller than tiny, because every word of it is changed.
pub fn sound() -> Assembled {
    let spec = Spec {
        layers: 1,
        hidden: 6,
        head_dim: 3,
        codebook_len: 3,
        plan_len: 2,
        steps: 3,
        horizon: 2,
        ..Spec::TINY
    };
    assemble::assemble(&Model::random(spec, 2))
}

/// Runs the programs of a policy as a controller does, with one KV cache for all of them.
pub struct Runner<'p> {
    policy: &'p Assembled,
    arena: Vec<f32>,
    cache: Vec<f32>,
    ints: [u32; INT_SLOTS],
    /// Number of valid rows of the cache.
    pub past: usize,
}

impl<'p> Runner<'p> {
    /// Makes memory full of garbage that must not matter.
    pub fn new(policy: &'p Assembled) -> Self {
        Self {
            policy,
            arena: Vec::new(),
            cache: vec![f32::NAN; policy.cache_len as usize],
            ints: [0; INT_SLOTS],
            past: 0,
        }
    }

    /// Runs one program; inputs that are shorter than their span are padded with zeros. Integers
    /// are given as floats without a fraction.
    pub fn run(&mut self, kind: Kind, inputs: &[(&str, &[f32])]) -> Result<(), ExecError> {
        let draft = self.policy.draft(kind);
        let words = self.policy.encode(kind);
        let program = self
            .policy
            .check(kind, &words)
            .expect("the program is sound");
        self.arena = vec![f32::NAN; program.arena_len()];
        for (port, place) in &draft.inputs {
            let (_, values) = inputs
                .iter()
                .find(|(name, _)| name == port)
                .expect("every input is set");
            match place {
                Place::Span(span) => {
                    let to = &mut self.arena[span.range()];
                    to.fill(0.0);
                    to[..values.len()].copy_from_slice(values);
                }
                Place::Int(slot) => self.ints[usize::from(slot.0)] = values[0] as u32,
            }
        }
        let mut machine = Machine {
            arena: &mut self.arena,
            cache: &mut self.cache,
            ints: self.ints,
            past: self.past,
            isa: Isa::detect(),
        };
        program.run(&self.policy.weights, &mut machine)?;
        self.ints = machine.ints;
        self.past += program.tokens();
        Ok(())
    }

    /// Returns an output of the program that ran last.
    pub fn output(&self, kind: Kind, port: &str) -> Vec<f32> {
        let outputs = &self.policy.draft(kind).outputs;
        let (_, place) = outputs
            .iter()
            .find(|(name, _)| *name == port)
            .expect("the program has the output");
        match place {
            Place::Span(span) => self.arena[span.range()].to_vec(),
            Place::Int(slot) => vec![self.ints[usize::from(slot.0)] as f32],
        }
    }
}
