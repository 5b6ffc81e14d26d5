//! Demonstrations in one safetensors file, written by `lads-collect` and read by the exporter.
//!
//! This is the kitchen's file. Those of other environments have the same form, less what they have not: `states`, `sub_task_ends`,
//! `recovery_noise` and `speed`.
//!
//! | tensor | type, shape | meaning |
//! |---|---|---|
//! | `observations` | f32 \[T, O\] | what a policy sees before each step |
//! | `states` | f32 \[T, O\] | the same without noise |
//! | `actions` | f32 \[T, A\] | what the expert wanted: the label |
//! | `executed` | f32 \[T, A\] | what was executed, recovery noise included, within \[-1, 1\] |
//! | `episode_offsets` | i64 \[E + 1\] | rows of episode e: `offsets[e]..offsets[e + 1]` |
//! | `instruction` | i64 \[E\] | index in the metadata's `instructions` |
//! | `sub_task_ends` | i64 \[E, 4\] | steps of the episode after which each sub-task's routine had ended |
//! | `seeds` | i64 \[E\] | the episode number of the random stream, see [`crate::environment::EpisodeSeed`] |
//! | `recovery_noise` | f32 \[E\] | standard deviation of the noise on the executed actions |
//! | `speed` | f32 \[E\] | the expert's speed factor |
//!
//! The metadata are strings; `instructions`, `observation_names`, `action_names`, `attempts`, `discarded` and `versions` hold JSON.
//! Writing goes to a temporary file that is renamed, so an existing dataset is replaced as a whole or not at all. Reading checks every
//! shape and offset before anything is used.

use std::collections::{BTreeMap, HashMap};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::expert::Transition;
use crate::instructions::Instruction;
use crate::kitchen::spec::{ACTION_LEN, OBSERVATION_LEN};
use crate::output;

/// Value of the metadata's `format`.
pub const FORMAT: &str = "lads-dataset";
/// Value of the metadata's `version`.
pub const FORMAT_VERSION: &str = "1";
/// Number of sub-tasks of an instruction.
pub const SUB_TASKS_PER_INSTRUCTION: usize = 4;

/// One successful demonstration.
#[derive(Clone, Debug, PartialEq)]
pub struct Demonstration {
    /// Index of the instruction.
    pub instruction: usize,
    /// Episode number of the demonstration's random stream.
    pub episode: u64,
    /// Control steps of the demonstration.
    pub transitions: Vec<Transition>,
    /// Steps after which each sub-task's routine had ended.
    pub sub_task_ends: [usize; SUB_TASKS_PER_INSTRUCTION],
    /// Standard deviation of the recovery noise.
    pub recovery_noise: f64,
    /// Speed factor of the expert.
    pub speed: f64,
}

/// A dataset: demonstrations and what is known about them.
#[derive(Clone, Debug, PartialEq)]
pub struct Dataset {
    /// Free strings, listed in the module's documentation.
    pub metadata: HashMap<String, String>,
    /// The instructions that the demonstrations point to.
    pub instructions: Vec<Instruction>,
    /// Demonstrations, ordered by instruction.
    pub demonstrations: Vec<Demonstration>,
}

/// Why a dataset cannot be written or read.
#[derive(Debug, Error)]
pub enum DatasetError {
    /// The file system refused an operation.
    #[error("{}: {source}", .path.display())]
    Io {
        /// The file's path.
        path: PathBuf,
        /// The file system's error.
        source: std::io::Error,
    },
    /// The file is not a dataset of this format.
    #[error("{}: {reason}; make one with lads-collect", .path.display())]
    Format {
        /// The file's path.
        path: PathBuf,
        /// What is wrong with the file.
        reason: String,
    },
}

impl Dataset {
    /// Number of control steps of all demonstrations.
    pub fn steps(&self) -> usize {
        self.demonstrations
            .iter()
            .map(|demonstration| demonstration.transitions.len())
            .sum()
    }

    /// Writes the dataset to a temporary file beside `path` and renames it.
    pub fn write(&self, path: &Path) -> Result<(), DatasetError> {
        write(path, &self.metadata, &self.instructions, &self.tensors())
    }

    fn tensors(&self) -> Vec<Tensor> {
        let (steps, episodes) = (self.steps(), self.demonstrations.len());
        let transitions = || {
            self.demonstrations
                .iter()
                .flat_map(|demonstration| &demonstration.transitions)
        };
        let per_episode =
            |value: fn(&Demonstration) -> i64| i64_bytes(self.demonstrations.iter().map(value));
        let lengths = self
            .demonstrations
            .iter()
            .map(|demonstration| demonstration.transitions.len() as i64);
        let offsets = std::iter::once(0).chain(lengths.scan(0, |sum, len| {
            *sum += len;
            Some(*sum)
        }));
        let ends = self
            .demonstrations
            .iter()
            .flat_map(|demonstration| demonstration.sub_task_ends)
            .map(|end| end as i64);
        vec![
            Tensor::new(
                "observations",
                Dtype::F32,
                &[steps, OBSERVATION_LEN],
                f32_bytes(transitions().flat_map(|t| t.observation)),
            ),
            Tensor::new(
                "states",
                Dtype::F32,
                &[steps, OBSERVATION_LEN],
                f32_bytes(transitions().flat_map(|t| t.state)),
            ),
            Tensor::new(
                "actions",
                Dtype::F32,
                &[steps, ACTION_LEN],
                f32_bytes(transitions().flat_map(|t| t.action)),
            ),
            Tensor::new(
                "executed",
                Dtype::F32,
                &[steps, ACTION_LEN],
                f32_bytes(transitions().flat_map(|t| t.executed)),
            ),
            Tensor::new(
                "episode_offsets",
                Dtype::I64,
                &[episodes + 1],
                i64_bytes(offsets),
            ),
            Tensor::new(
                "instruction",
                Dtype::I64,
                &[episodes],
                per_episode(|d| d.instruction as i64),
            ),
            Tensor::new(
                "sub_task_ends",
                Dtype::I64,
                &[episodes, SUB_TASKS_PER_INSTRUCTION],
                i64_bytes(ends),
            ),
            Tensor::new(
                "seeds",
                Dtype::I64,
                &[episodes],
                per_episode(|d| d.episode as i64),
            ),
            Tensor::new(
                "recovery_noise",
                Dtype::F32,
                &[episodes],
                f32_bytes(self.demonstrations.iter().map(|d| d.recovery_noise as f32)),
            ),
            Tensor::new(
                "speed",
                Dtype::F32,
                &[episodes],
                f32_bytes(self.demonstrations.iter().map(|d| d.speed as f32)),
            ),
        ]
    }

    /// Reads a dataset that [`Dataset::write`] wrote.
    pub fn read(path: &Path) -> Result<Self, DatasetError> {
        let bytes = lads_host::input::read(path).map_err(|source| DatasetError::Io {
            path: path.to_path_buf(),
            source,
        })?;
        Self::from_bytes(&bytes).map_err(|reason| DatasetError::Format {
            path: path.to_path_buf(),
            reason,
        })
    }

    fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        let (_, header) = SafeTensors::read_metadata(bytes)
            .map_err(|error| format!("not a safetensors file ({error})"))?;
        let metadata = header.metadata().clone().unwrap_or_default();
        for (key, expected) in [("format", FORMAT), ("version", FORMAT_VERSION)] {
            if metadata.get(key).map(String::as_str) != Some(expected) {
                return Err(format!("its {key} is not \"{expected}\""));
            }
        }
        let instructions: Vec<Instruction> =
            serde_json::from_str(metadata.get("instructions").map_or("", String::as_str))
                .map_err(|error| format!("instructions: {error}"))?;
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
        let columns = Columns::new(&tensors)?;
        let demonstrations = (0..columns.instruction.len())
            .map(|episode| columns.demonstration(episode, instructions.len()))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            metadata,
            instructions,
            demonstrations,
        })
    }
}

/// A tensor to be written.
pub(crate) struct Tensor {
    name: &'static str,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

impl Tensor {
    /// Names a tensor; the bytes are its elements, little endian, the last index fastest.
    pub(crate) fn new(name: &'static str, dtype: Dtype, shape: &[usize], bytes: Vec<u8>) -> Self {
        Self {
            name,
            dtype,
            shape: shape.to_vec(),
            bytes,
        }
    }
}

/// Writes a dataset of any environment to a temporary file beside `path` and renames it.
pub(crate) fn write(
    path: &Path,
    metadata: &HashMap<String, String>,
    instructions: &[Instruction],
    tensors: &[Tensor],
) -> Result<(), DatasetError> {
    let io = |source| DatasetError::Io {
        path: path.to_path_buf(),
        source,
    };
    let bytes =
        to_bytes(metadata, instructions, tensors).map_err(|error| DatasetError::Format {
            path: path.to_path_buf(),
            reason: error.to_string(),
        })?;
    let mut draft = output::draft_with_folder(path).map_err(io)?;
    draft.write_all(&bytes).map_err(io)?;
    draft.commit().map_err(io)
}

fn to_bytes(
    metadata: &HashMap<String, String>,
    instructions: &[Instruction],
    tensors: &[Tensor],
) -> Result<Vec<u8>, safetensors::SafeTensorError> {
    let mut metadata = metadata.clone();
    let instructions = serde_json::to_string(instructions).unwrap_or_default();
    for (key, value) in [
        ("format", FORMAT),
        ("version", FORMAT_VERSION),
        ("instructions", &instructions),
    ] {
        metadata.insert(key.to_owned(), value.to_owned());
    }
    let views = tensors
        .iter()
        .map(|tensor| {
            let view = TensorView::new(tensor.dtype, tensor.shape.clone(), &tensor.bytes)?;
            Ok((tensor.name, view))
        })
        .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()?;
    Ok(sort_header(safetensors::serialize(views, Some(metadata))?))
}

/// The tensors of a file as numbers, with lengths that fit each other.
struct Columns {
    observations: Vec<f32>,
    states: Vec<f32>,
    actions: Vec<f32>,
    executed: Vec<f32>,
    offsets: Vec<usize>,
    instruction: Vec<usize>,
    ends: Vec<usize>,
    seeds: Vec<usize>,
    recovery_noise: Vec<f32>,
    speed: Vec<f32>,
}

impl Columns {
    fn new(tensors: &SafeTensors) -> Result<Self, String> {
        let offsets = indices(tensors, "episode_offsets", None)?;
        let steps = offsets.last().copied().unwrap_or(0);
        if offsets.first() != Some(&0) || !offsets.is_sorted() {
            return Err("episode_offsets do not rise from 0".to_owned());
        }
        let episodes = offsets.len() - 1;
        Ok(Self {
            observations: floats(tensors, "observations", steps * OBSERVATION_LEN)?,
            states: floats(tensors, "states", steps * OBSERVATION_LEN)?,
            actions: floats(tensors, "actions", steps * ACTION_LEN)?,
            executed: floats(tensors, "executed", steps * ACTION_LEN)?,
            instruction: indices(tensors, "instruction", Some(episodes))?,
            ends: indices(
                tensors,
                "sub_task_ends",
                Some(episodes * SUB_TASKS_PER_INSTRUCTION),
            )?,
            seeds: indices(tensors, "seeds", Some(episodes))?,
            recovery_noise: floats(tensors, "recovery_noise", episodes)?,
            speed: floats(tensors, "speed", episodes)?,
            offsets,
        })
    }

    fn demonstration(&self, episode: usize, instructions: usize) -> Result<Demonstration, String> {
        let instruction = self.instruction[episode];
        if instruction >= instructions {
            return Err(format!(
                "episode {episode} has instruction {instruction} of {instructions}"
            ));
        }
        let transitions = (self.offsets[episode]..self.offsets[episode + 1])
            .map(|step| Transition {
                observation: row(&self.observations, step),
                state: row(&self.states, step),
                action: row(&self.actions, step),
                executed: row(&self.executed, step),
            })
            .collect();
        Ok(Demonstration {
            instruction,
            episode: self.seeds[episode] as u64,
            transitions,
            sub_task_ends: std::array::from_fn(|index| {
                self.ends[episode * SUB_TASKS_PER_INSTRUCTION + index]
            }),
            recovery_noise: f64::from(self.recovery_noise[episode]),
            speed: f64::from(self.speed[episode]),
        })
    }
}

/// Header of the file with sorted keys; the library writes the metadata in an order that differs from run to run.
#[derive(Serialize, Deserialize)]
struct Header {
    #[serde(rename = "__metadata__")]
    metadata: BTreeMap<String, String>,
    #[serde(flatten)]
    tensors: BTreeMap<String, serde_json::Value>,
}

/// Sorts the file's header in place, which keeps its length, so that the same tensors and metadata always give the same bytes.
fn sort_header(mut file: Vec<u8>) -> Vec<u8> {
    let header_len = file
        .first_chunk::<8>()
        .map_or(0, |bytes| u64::from_le_bytes(*bytes) as usize);
    if let Some(header) = file.get_mut(8..8 + header_len)
        && let Ok(sorted) = serde_json::from_slice::<Header>(header)
        && let Ok(mut text) = serde_json::to_vec(&sorted)
        && text.len() <= header_len
    {
        text.resize(header_len, b' ');
        header.copy_from_slice(&text);
    }
    file
}

fn row<const N: usize>(values: &[f32], index: usize) -> [f32; N] {
    std::array::from_fn(|column| values[index * N + column])
}

fn floats(tensors: &SafeTensors, name: &str, len: usize) -> Result<Vec<f32>, String> {
    let numbers = elements(tensors, name, Dtype::F32)?
        .chunks_exact(4)
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    let numbers: Vec<f32> = numbers.collect();
    if numbers.len() == len {
        Ok(numbers)
    } else {
        Err(format!(
            "{name} has {} elements, expected {len}",
            numbers.len()
        ))
    }
}

fn indices(tensors: &SafeTensors, name: &str, len: Option<usize>) -> Result<Vec<usize>, String> {
    let numbers = elements(tensors, name, Dtype::I64)?
        .chunks_exact(8)
        .map(|b| {
            usize::try_from(i64::from_le_bytes([
                b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7],
            ]))
        });
    let numbers = numbers
        .collect::<Result<Vec<_>, _>>()
        .map_err(|_| format!("{name} has a negative element"))?;
    match len {
        Some(len) if numbers.len() != len => Err(format!(
            "{name} has {} elements, expected {len}",
            numbers.len()
        )),
        _ => Ok(numbers),
    }
}

fn elements<'t>(tensors: &'t SafeTensors, name: &str, dtype: Dtype) -> Result<&'t [u8], String> {
    let tensor = tensors
        .tensor(name)
        .map_err(|_| format!("it has no tensor {name}"))?;
    if tensor.dtype() == dtype {
        Ok(tensor.data())
    } else {
        Err(format!(
            "{name} is {:?}, expected {dtype:?}",
            tensor.dtype()
        ))
    }
}

/// Bytes of `f32` elements as a tensor stores them, little endian.
pub(crate) fn f32_bytes(values: impl Iterator<Item = f32>) -> Vec<u8> {
    values.flat_map(f32::to_le_bytes).collect()
}

/// Bytes of `i64` elements as a tensor stores them, little endian.
pub(crate) fn i64_bytes(values: impl Iterator<Item = i64>) -> Vec<u8> {
    values.flat_map(i64::to_le_bytes).collect()
}
