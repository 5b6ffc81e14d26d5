//! Golden episode of a bundle: recorded observations, with the reference's indices and actions.
//!
//! It is stored as base64 of a safetensors blob in the model's metadata. Invariant of a [`Golden`]:
//! all parts have the length that the contract states, indices are inside the codebook, and every
//! number is finite.

use base64::Engine as _;
use safetensors::{Dtype, SafeTensors};

use crate::contract::{Channel, Contract, DType, Faults, Role, roles_are_known};
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
        Self::read(base64, contract, &Faults::default())
    }

    /// Decodes the episode of a contract that has faults: what they touch is not compared.
    pub(crate) fn read(
        base64: &str,
        contract: &Contract,
        faults: &Faults,
    ) -> Result<Self, BundleError> {
        Self::compared(base64, contract, faults).map_err(|problems| BundleError::Golden {
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

    fn compared(base64: &str, contract: &Contract, faults: &Faults) -> Result<Self, Vec<String>> {
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
        let known = roles_are_known(contract, faults);
        let listed = known && faults.counted("instructions") && !contract.instructions.is_empty();
        let instruction = (contract.words().filter(|_| listed))
            .map(|_| instruction(&tensors, contract))
            .transpose()
            .map_err(|problem| problems.push(problem))
            .ok();
        // Without a number of steps, nothing else has a shape that it must have.
        let Some(steps) = steps else {
            return Err(problems);
        };
        let free = |number: usize, fields: &[&str]| {
            let at = format!("channels[{number}]");
            let mut fields = fields.iter().map(|field| format!("{at}.{field}"));
            fields.all(|field| faults.free(&[&field]))
        };
        let shaped = |number: usize| free(number, &["name", "role", "dtype", "shape"]);
        let of = |role| {
            let all = contract.channels.iter().enumerate();
            all.filter(move |(number, channel)| channel.role == role && shaped(*number))
        };
        let mut observations = vec![];
        for (number, channel) in of(Role::Observation) {
            let limited = free(number, &["elements", "min", "max"]);
            match recorded(&tensors, channel, steps, limited) {
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
        let drawn = of(Role::Noise).next().filter(|_| known);
        let noise = or_report(noise(&tensors, steps, drawn.map(|(_, channel)| channel)));
        let actions = of(Role::Action).next().map(|(_, channel)| {
            let shape = [&[steps][..], &channel.shape].concat();
            floats(&tensors, "actions", &shape)
        });
        let actions = or_report(actions.unwrap_or(Ok(vec![])));
        let selected = if faults.free(&["family"]) {
            selected(&tensors, steps, choices(contract))
        } else {
            Ok(vec![])
        };
        let selected = selected.unwrap_or_else(|problem| {
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

/// Returns the number of indices that the policy selects from; `None` for one that selects none.
fn choices(contract: &Contract) -> Option<usize> {
    let blueprint = contract.family.kind().blueprint(contract);
    let scores = blueprint
        .calls
        .iter()
        .find_map(|call| call.select.as_ref())?;
    let mut states = blueprint.states.iter();
    let scores = states.find(|state| state.name == *scores)?;
    scores.width.as_ref().map(|(width, _)| *width)
}

fn selected(
    tensors: &SafeTensors,
    steps: usize,
    choices: Option<usize>,
) -> Result<Vec<u32>, String> {
    let there = tensors.tensor("selected").is_ok();
    let Some(choices) = choices else {
        if there {
            return Err("it has a tensor `selected`, and the policy selects no index".into());
        }
        return Ok(vec![]);
    };
    let selected = integers(tensors, "selected")?;
    if selected.len() != steps {
        let found = selected.len();
        return Err(format!("`selected` has {found} steps, not {steps}"));
    }
    let inside = |&index: &i64| {
        let index = u32::try_from(index).ok();
        index.filter(|&index| (index as usize) < choices)
    };
    if let Some(index) = selected.iter().find(|index| inside(index).is_none()) {
        return Err(format!(
            "`selected` has the index {index}, the policy selects from {choices}"
        ));
    }
    Ok(selected.iter().filter_map(inside).collect())
}

fn noise(tensors: &SafeTensors, steps: usize, drawn: Option<&Channel>) -> Result<Vec<f32>, String> {
    let Ok(noise) = tensors.tensor("noise") else {
        return match drawn {
            Some(_) => Err("it has no tensor `noise`, and the policy draws noise".into()),
            None => Ok(vec![]),
        };
    };
    let width = noise.shape().get(1).copied().unwrap_or(0);
    if let Some(drawn) = drawn
        && (width == 0 || !width.is_multiple_of(drawn.len().max(1)))
    {
        return Err(format!(
            "`noise` has rows of {width}, which are no whole draws of {} elements",
            drawn.len()
        ));
    }
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

/// Reads the values of a channel, which lie inside the contract's limits if it is `limited`.
fn recorded(
    tensors: &SafeTensors,
    channel: &Channel,
    steps: usize,
    limited: bool,
) -> Result<Recorded, String> {
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
    let recorded = match channel.dtype {
        DType::F32 => Recorded::F32(floats(tensors, &name, &shape)?),
        DType::U8 => Recorded::U8(bytes(Dtype::U8)?),
        DType::I32 => {
            let bytes = bytes(Dtype::I32)?;
            let words = bytes.as_chunks().0.iter();
            Recorded::I32(words.map(|&word| i32::from_le_bytes(word)).collect())
        }
    };
    let refused = match &recorded {
        Recorded::F32(values) => outside(channel, values.iter().copied()),
        Recorded::I32(values) => outside(channel, values.iter().map(|&value| value as f32)),
        Recorded::U8(values) => outside(channel, values.iter().map(|&value| f32::from(value))),
    };
    match refused.filter(|_| limited) {
        Some((i, value)) => Err(format!(
            "`{name}` has {value} at step {}, element {}, outside the contract's limits",
            i / channel.len().max(1),
            i % channel.len().max(1)
        )),
        None => Ok(recorded),
    }
}

/// Finds the first value that a controller would refuse.
fn outside(channel: &Channel, values: impl Iterator<Item = f32>) -> Option<(usize, f32)> {
    let all = channel.limits();
    let limits = |i: usize| {
        let element = channel.elements.get(i % channel.len().max(1));
        element.map_or(all, |element| (element.min, element.max))
    };
    values.enumerate().find(|&(i, value)| {
        let (min, max) = limits(i);
        !(min..=max).contains(&value)
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
