//! Recorded episodes of random policies: observations, instructions and resets, and the answers of the exporter's twin of the schedule with
//! ONNX Runtime.
//!
//! `python -m lads_exporter random` makes the bundles and `python -m lads_exporter episode` the episodes; `lads_exporter/episode.py` says
//! what is in one. `tests/parity/families.py` makes them all, in the folder that [`FOLDER`] names.

use std::path::{Path, PathBuf};

use lads_core::{ChannelId, Controller, DType, Data, Instruction, Policy, StepReport};
use safetensors::{SafeTensors, tensor::TensorView};

/// Environment variable that names the folder of bundles and episodes.
pub const FOLDER: &str = "LADS_FAMILIES";

/// Returns the folder of the bundles and episodes.
///
/// # Panics
///
/// When nobody says where.
pub fn folder() -> PathBuf {
    let named = std::env::var_os(FOLDER);
    named.map_or_else(
        || panic!("{FOLDER} names no folder; make one: python tests/parity/families.py FOLDER"),
        PathBuf::from,
    )
}

/// Returns the kinds of random policies in the folder, in the order of their names.
///
/// # Panics
///
/// When the folder cannot be read.
pub fn kinds() -> Vec<String> {
    let folder = folder();
    let rows = std::fs::read_dir(&folder);
    let rows = rows.unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut found: Vec<String> = rows
        .map(|row| row.expect("it can be read").path())
        .filter(|path| path.extension().is_some_and(|ending| ending == "onnx"))
        .filter_map(|path| Some(path.file_stem()?.to_str()?.to_owned()))
        .collect();
    found.sort();
    found
}

/// Values of a channel over all steps.
#[derive(Debug)]
enum Values {
    F32(Vec<f32>),
    U8(Vec<u8>),
    I32(Vec<i32>),
}

impl Values {
    fn row(&self, step: usize, len: usize) -> Data<'_> {
        let range = step * len..(step + 1) * len;
        match self {
            Self::F32(values) => Data::F32(&values[range]),
            Self::U8(values) => Data::U8(&values[range]),
            Self::I32(values) => Data::I32(&values[range]),
        }
    }
}

/// A recorded episode.
#[derive(Debug)]
pub struct Episode {
    /// Event before each step: nothing (-1), a reset (-2), or the instruction that is set.
    pub events: Vec<i64>,
    /// Index in force after each step; -1 where none is selected.
    pub selected: Vec<i64>,
    /// Actions, `[T, A]`.
    pub actions: Vec<f32>,
    /// Noise, `[T, N]`, empty without noise.
    noise: Vec<f32>,
    channels: Vec<(ChannelId, usize, Values)>,
    noise_channel: Option<ChannelId>,
}

fn floats(tensor: &TensorView) -> Vec<f32> {
    let words = tensor.data().as_chunks().0.iter();
    words.map(|&word| f32::from_le_bytes(word)).collect()
}

fn integers(tensor: &TensorView) -> Vec<i64> {
    let words = tensor.data().as_chunks().0.iter();
    words.map(|&word| i64::from_le_bytes(word)).collect()
}

impl Episode {
    /// Reads an episode of a policy.
    ///
    /// # Panics
    ///
    /// When it cannot be read, or misses something.
    pub fn open(path: &Path, policy: &Policy) -> Self {
        let bytes =
            std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let tensors = SafeTensors::deserialize(&bytes).expect("it is a safetensors file");
        let tensor = |name: &str| {
            let found = tensors.tensor(name);
            found.unwrap_or_else(|error| panic!("{}: {name}: {error}", path.display()))
        };
        let channels = policy.contract().observations().map(|channel| {
            let recorded = tensor(&format!("channel.{}", channel.name()));
            let values = match channel.dtype() {
                DType::F32 => Values::F32(floats(&recorded)),
                DType::U8 => Values::U8(recorded.data().to_vec()),
                DType::I32 => {
                    let words = recorded.data().as_chunks().0.iter();
                    Values::I32(words.map(|&word| i32::from_le_bytes(word)).collect())
                }
            };
            (channel.id(), channel.len(), values)
        });
        Self {
            events: integers(&tensor("event")),
            selected: integers(&tensor("selected")),
            actions: floats(&tensor("actions")),
            noise: tensors.tensor("noise").map_or(vec![], |all| floats(&all)),
            channels: channels.collect(),
            noise_channel: policy.contract().noise_channel().map(|found| found.id()),
        }
    }

    /// Number of control steps.
    pub fn steps(&self) -> usize {
        self.events.len()
    }

    /// Whether the episode has noise.
    pub fn is_noisy(&self) -> bool {
        !self.noise.is_empty()
    }

    /// Returns the inputs of each step, with the recorded noise or without.
    pub fn inputs(&self, with_noise: bool) -> Vec<Vec<(ChannelId, Data<'_>)>> {
        let width = self.noise.len() / self.steps().max(1);
        let row = |step: usize| {
            let channels = self.channels.iter();
            let given = channels.map(|(id, len, values)| (*id, values.row(step, *len)));
            let noise = self.noise_channel.filter(|_| with_noise && width > 0);
            let noise = noise.map(|id| (id, Data::F32(&self.noise[step * width..][..width])));
            given.chain(noise).collect()
        };
        (0..self.steps()).map(row).collect()
    }

    /// Drives a controller through the episode on these inputs; allocates nothing.
    ///
    /// # Panics
    ///
    /// When a step is refused.
    pub fn drive(
        &self,
        controller: &mut Controller<'_, '_>,
        inputs: &[Vec<(ChannelId, Data<'_>)>],
        action: &mut [f32],
        mut see: impl FnMut(usize, &StepReport, &[f32]),
    ) {
        for (step, (&event, given)) in self.events.iter().zip(inputs).enumerate() {
            match event {
                -1 => {}
                -2 => controller.reset(),
                id => controller
                    .set_instruction(Instruction::Id(id as u32))
                    .expect("a known instruction"),
            }
            let report = controller
                .step_with(given, action)
                .unwrap_or_else(|error| panic!("step {step}: {error}"));
            see(step, &report, action);
        }
    }
}
