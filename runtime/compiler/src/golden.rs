//! Golden episode of a bundle: recorded observations, with the reference's indices and actions.
//!
//! It is stored as base64 of a safetensors blob in the model's metadata. Invariant of a [`Golden`]:
//! all parts have the length that the contract states, indices are inside the codebook, and every
//! number is finite.

use base64::Engine as _;
use safetensors::{Dtype, SafeTensors};

use crate::contract::{Channel, Contract, DType};
use crate::error::BundleError;

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
        Self::read(base64, contract).map_err(|problem| BundleError::Golden {
            problem: problem.into(),
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

    fn read(base64: &str, contract: &Contract) -> Result<Self, String> {
        let blob = base64::engine::general_purpose::STANDARD
            .decode(base64.trim())
            .map_err(|error| format!("is not base64: {error}"))?;
        let tensors = SafeTensors::deserialize(&blob)
            .map_err(|error| format!("is not a safetensors file: {error}"))?;
        let (_, metadata) = SafeTensors::read_metadata(&blob)
            .map_err(|error| format!("is not a safetensors file: {error}"))?;
        let tolerance = metadata
            .metadata()
            .as_ref()
            .and_then(|pairs| pairs.get("tolerance"))
            .ok_or("its metadata has no `tolerance`")?;
        let tolerance: f32 = tolerance
            .parse()
            .map_err(|_| format!("its `tolerance` \"{tolerance}\" is not a number"))?;
        if !(tolerance.is_finite() && tolerance > 0.0) {
            return Err(format!("its `tolerance` {tolerance} is not positive"));
        }
        let has = |name: &str| tensors.tensor(name).is_ok();
        let steps = tensors
            .tensor("actions")
            .map_err(|_| "it has no tensor `actions`".to_owned())?
            .shape()
            .first()
            .copied()
            .unwrap_or(0);
        if steps == 0 {
            return Err("it has no steps".into());
        }
        let instruction = if contract.words().is_some() {
            Some(instruction(&tensors, contract)?)
        } else {
            None
        };
        let observations = contract
            .observations()
            .map(|channel| recorded(&tensors, channel, steps))
            .collect::<Result<Vec<_>, _>>()?;
        let selected = if has("selected") {
            let selected = integers(&tensors, "selected")?;
            if selected.len() != steps {
                return Err(format!(
                    "`selected` has {} steps, not {steps}",
                    selected.len()
                ));
            }
            selected
                .iter()
                .map(|&index| u32::try_from(index))
                .collect::<Result<_, _>>()
                .map_err(|_| "`selected` has an index below zero".to_owned())?
        } else {
            vec![]
        };
        let noise = if has("noise") {
            let shape = tensors
                .tensor("noise")
                .map(|tensor| tensor.shape().to_vec());
            let width = shape
                .ok()
                .and_then(|shape| shape.get(1).copied())
                .unwrap_or(0);
            floats(&tensors, "noise", &[steps, width])?
        } else {
            vec![]
        };
        let action = [&[steps][..], &contract.action().shape].concat();
        let actions = floats(&tensors, "actions", &action)?;
        Ok(Self {
            instruction,
            observations,
            selected,
            noise,
            actions,
            tolerance,
            steps,
        })
    }
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
