//! Golden episode of a bundle: recorded observations, with the reference's indices and actions.
//!
//! It is stored as base64 of a safetensors blob in the model's metadata. Invariant of a [`Golden`]:
//! all parts have the length that the contract states, indices are inside the codebook, and every
//! number is finite.

use base64::Engine as _;
use safetensors::{Dtype, SafeTensors};

use crate::contract::{Channel, Contract, DType};
use crate::error::{BundleError, Line};

/// One recorded episode.
#[derive(Debug, Clone, PartialEq)]
pub struct Golden {
    /// Index of the instruction; `None` for a policy that takes none.
    pub instruction: Option<usize>,
    /// Values of each observation channel over all steps, in the contract's order.
    pub observations: Vec<Recorded>,
    /// Index in force at each control step, `[T]`; empty for a policy that selects none.
    pub selected: Vec<u32>,
    /// Draws of noise of each step in the order in which they are used, `[T, N]`; empty for a
    /// policy without noise.
    pub noise: Vec<f32>,
    /// Actions after clipping to the contract's limits, `[T, A]`.
    pub actions: Vec<f32>,
    /// Largest absolute difference of an action that counts as equal.
    pub tolerance: f32,
    steps: usize,
}

/// Values of a channel over all steps, `[T, elements]`.
#[derive(Debug, Clone, PartialEq)]
pub enum Recorded {
    /// Values of a channel of floats.
    F32(Vec<f32>),
    /// Values of a channel of bytes.
    U8(Vec<u8>),
    /// Values of a channel of integers.
    I32(Vec<i32>),
}

impl Golden {
    /// Decodes the episode from the metadata's value.
    pub fn parse(base64: &str, contract: &Contract) -> Result<Self, BundleError> {
        Self::read(base64, contract).map_err(|problems| BundleError::Golden {
            problems: problems.into_iter().map(Line::from).collect(),
        })
    }

    /// Returns the number of control steps, `T`.
    pub fn steps(&self) -> usize {
        self.steps
    }

    /// Returns the number of elements of noise of a step; 0 without noise.
    pub fn noise_len(&self) -> usize {
        self.noise.len() / self.steps.max(1)
    }

    fn read(base64: &str, contract: &Contract) -> Result<Self, Vec<String>> {
        let blob = base64::engine::general_purpose::STANDARD
            .decode(base64.trim())
            .map_err(|error| vec![format!("is not base64: {error}")])?;
        let damaged = |error| vec![format!("is not a safetensors file: {error}")];
        let tensors = SafeTensors::deserialize(&blob).map_err(damaged)?;
        let (_, metadata) = SafeTensors::read_metadata(&blob).map_err(damaged)?;
        let metadata = metadata.metadata().as_ref();
        let tolerance = tolerance(metadata.and_then(|pairs| pairs.get("tolerance")));
        let steps = steps(&tensors);
        let mut problems = vec![];
        let tolerance = tolerance.map_err(|problem| problems.push(problem)).ok();
        let steps = steps.map_err(|problem| problems.push(problem)).ok();
        let instruction = (contract.words())
            .map(|_| instruction(&tensors, contract))
            .transpose()
            .map_err(|problem| problems.push(problem))
            .ok();
        // Without a number of steps, nothing else has a shape that it must have.
        let Some(steps) = steps else {
            return Err(problems);
        };
        let mut observations = vec![];
        for channel in contract.observations() {
            match recorded(&tensors, channel, steps) {
                Ok(values) => observations.push(values),
                Err(problem) => problems.push(problem),
            }
        }
        let mut or_report = |read: Result<Vec<f32>, String>| -> Vec<f32> {
            read.unwrap_or_else(|problem| {
                problems.push(problem);
                vec![]
            })
        };
        let noise = or_report(noise(&tensors, steps));
        let action = [&[steps][..], &contract.action().shape].concat();
        let actions = or_report(floats(&tensors, "actions", &action));
        let selected = selected(&tensors, steps).unwrap_or_else(|problem| {
            problems.push(problem);
            vec![]
        });
        match (tolerance, instruction) {
            (Some(tolerance), Some(instruction)) if problems.is_empty() => Ok(Self {
                instruction,
                observations,
                selected,
                noise,
                actions,
                tolerance,
                steps,
            }),
            _ => Err(problems),
        }
    }
}

fn tolerance(text: Option<&String>) -> Result<f32, String> {
    let text = text.ok_or("its metadata has no `tolerance`")?;
    let tolerance: f32 = text
        .parse()
        .map_err(|_| format!("its `tolerance` \"{text}\" is not a number"))?;
    if !(tolerance.is_finite() && tolerance > 0.0) {
        return Err(format!("its `tolerance` {tolerance} is not positive"));
    }
    Ok(tolerance)
}

/// Returns the number of control steps, which the actions tell.
fn steps(tensors: &SafeTensors) -> Result<usize, String> {
    let actions = tensors.tensor("actions");
    let actions = actions.map_err(|_| "it has no tensor `actions`".to_owned())?;
    let steps = actions.shape().first().copied();
    steps
        .filter(|&steps| steps > 0)
        .ok_or_else(|| "it has no steps".into())
}

fn selected(tensors: &SafeTensors, steps: usize) -> Result<Vec<u32>, String> {
    if tensors.tensor("selected").is_err() {
        return Ok(vec![]);
    }
    let selected = integers(tensors, "selected")?;
    if selected.len() != steps {
        let found = selected.len();
        return Err(format!("`selected` has {found} steps, not {steps}"));
    }
    let selected = selected.iter().map(|&index| u32::try_from(index));
    let selected: Result<_, _> = selected.collect();
    selected.map_err(|_| "`selected` has an index below zero".to_owned())
}

fn noise(tensors: &SafeTensors, steps: usize) -> Result<Vec<f32>, String> {
    let Ok(noise) = tensors.tensor("noise") else {
        return Ok(vec![]);
    };
    let width = noise.shape().get(1).copied().unwrap_or(0);
    floats(tensors, "noise", &[steps, width])
}

fn instruction(tensors: &SafeTensors, contract: &Contract) -> Result<usize, String> {
    let index = match integers(tensors, "instruction")?[..] {
        [index] => usize::try_from(index)
            .ok()
            .filter(|&index| index < contract.instructions.len()),
        _ => None,
    };
    index.ok_or_else(|| {
        format!(
            "`instruction` is not an index of the {} instructions",
            contract.instructions.len()
        )
    })
}

fn recorded(tensors: &SafeTensors, channel: &Channel, steps: usize) -> Result<Recorded, String> {
    let name = format!("channel.{}", channel.name);
    let shape = [&[steps][..], &channel.shape].concat();
    let bytes = |dtype: Dtype| -> Result<Vec<u8>, String> {
        let tensor = tensors
            .tensor(&name)
            .map_err(|_| format!("it has no tensor `{name}`"))?;
        if tensor.dtype() != dtype || tensor.shape() != shape {
            return Err(format!(
                "`{name}` is {:?} {:?}, not {dtype:?} {shape:?}",
                tensor.dtype(),
                tensor.shape()
            ));
        }
        Ok(tensor.data().to_vec())
    };
    Ok(match channel.dtype {
        DType::F32 => Recorded::F32(floats(tensors, &name, &shape)?),
        DType::U8 => Recorded::U8(bytes(Dtype::U8)?),
        DType::I32 => {
            let bytes = bytes(Dtype::I32)?;
            let words = bytes.as_chunks().0.iter();
            Recorded::I32(words.map(|&word| i32::from_le_bytes(word)).collect())
        }
    })
}

fn integers(tensors: &SafeTensors, name: &str) -> Result<Vec<i64>, String> {
    let tensor = tensors
        .tensor(name)
        .map_err(|_| format!("it has no tensor `{name}`"))?;
    if tensor.dtype() != Dtype::I64 || tensor.shape().len() != 1 {
        return Err(format!(
            "`{name}` is {:?} {:?}, not I64 of one axis",
            tensor.dtype(),
            tensor.shape()
        ));
    }
    Ok(tensor
        .data()
        .as_chunks()
        .0
        .iter()
        .map(|&word| i64::from_le_bytes(word))
        .collect())
}

fn floats(tensors: &SafeTensors, name: &str, shape: &[usize]) -> Result<Vec<f32>, String> {
    let tensor = tensors
        .tensor(name)
        .map_err(|_| format!("it has no tensor `{name}`"))?;
    if tensor.dtype() != Dtype::F32 || tensor.shape() != shape {
        return Err(format!(
            "`{name}` is {:?} {:?}, not F32 {shape:?}",
            tensor.dtype(),
            tensor.shape()
        ));
    }
    let data: Vec<f32> = tensor
        .data()
        .as_chunks()
        .0
        .iter()
        .map(|&word| f32::from_le_bytes(word))
        .collect();
    if data.iter().any(|x| !x.is_finite()) {
        return Err(format!("`{name}` has elements that are not finite"));
    }
    Ok(data)
}
