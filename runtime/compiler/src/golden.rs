//! The golden episode of a bundle: recorded observations, the plans and actions that the reference gave for them.
//!
//! Stored as base64 of a safetensors blob in the model's metadata. Invariant of a [`Golden`]: all parts have the length that the
//! contract says, plans are indices into the codebook, and every number is finite.

use base64::Engine as _;
use safetensors::{Dtype, SafeTensors};

use crate::contract::Contract;
use crate::error::BundleError;

/// One recorded episode.
#[derive(Debug, Clone, PartialEq)]
pub struct Golden {
    /// Index of the instruction.
    pub instruction: usize,
    /// `[T, O]`, raw units.
    pub observations: Vec<f32>,
    /// `[T]`: the plan in force at each control step.
    pub plans: Vec<u32>,
    /// `[T, A]`, after clipping to the contract's limits.
    pub actions: Vec<f32>,
    /// Largest absolute difference of an action that counts as equal.
    pub tolerance: f32,
}

impl Golden {
    /// Reads the metadata's value.
    pub fn parse(base64: &str, contract: &Contract) -> Result<Self, BundleError> {
        Self::read(base64, contract).map_err(|problem| BundleError::Golden {
            problem: problem.into(),
        })
    }

    /// Control steps, `T`.
    pub fn steps(&self) -> usize {
        self.plans.len()
    }

    fn read(base64: &str, contract: &Contract) -> Result<Self, String> {
        let blob = base64::engine::general_purpose::STANDARD
            .decode(base64.trim())
            .map_err(|error| format!("is no base64: {error}"))?;
        let tensors = SafeTensors::deserialize(&blob)
            .map_err(|error| format!("is no safetensors file: {error}"))?;
        let (_, metadata) = SafeTensors::read_metadata(&blob)
            .map_err(|error| format!("is no safetensors file: {error}"))?;
        let tolerance = metadata
            .metadata()
            .as_ref()
            .and_then(|pairs| pairs.get("tolerance"))
            .ok_or("its metadata has no `tolerance`")?;
        let tolerance: f32 = tolerance
            .parse()
            .map_err(|_| format!("its `tolerance` \"{tolerance}\" is no number"))?;
        if !(tolerance.is_finite() && tolerance > 0.0) {
            return Err(format!("its `tolerance` {tolerance} is not positive"));
        }
        let plans = integers(&tensors, "plans")?;
        let steps = plans.len();
        let codebook = contract.codebook.size;
        let plans: Option<Vec<u32>> = plans
            .iter()
            .map(|&plan| {
                u32::try_from(plan)
                    .ok()
                    .filter(|&plan| (plan as usize) < codebook)
            })
            .collect();
        let plans = plans
            .ok_or_else(|| format!("`plans` reach beyond the codebook's {codebook} entries"))?;
        let instruction = match integers(&tensors, "instruction")?[..] {
            [index] => usize::try_from(index)
                .ok()
                .filter(|&index| index < contract.instructions.len()),
            _ => None,
        };
        let instruction = instruction.ok_or_else(|| {
            format!(
                "`instruction` is no index of the {} instructions",
                contract.instructions.len()
            )
        })?;
        if steps == 0 {
            return Err("it has no steps".into());
        }
        let observations = floats(
            &tensors,
            "observations",
            [steps, contract.observation.len()],
        )?;
        let actions = floats(&tensors, "actions", [steps, contract.action.len()])?;
        Ok(Self {
            instruction,
            observations,
            plans,
            actions,
            tolerance,
        })
    }
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

fn floats(tensors: &SafeTensors, name: &str, shape: [usize; 2]) -> Result<Vec<f32>, String> {
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
