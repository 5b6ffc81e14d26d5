//! Converts numpy arrays in and out: checks them against a channel, then copies.
//!
//! What can fail: an object that is not an array, another element type, another shape, rows that
//! are not contiguous, elements that are not aligned, an array to write into that is read-only.
//! Nothing is converted: a cast would hide a mistake and cost time in every step.

use lads_core::{Channel, ChannelId, Contract, DType, Data};
use numpy::{
    Element, PyArray1, PyArrayDyn, PyArrayMethods, PyReadwriteArrayDyn, PyUntypedArray,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::errors::InputError;

/// Elements up to which an array is copied without rust-numpy's table of borrowed arrays, which
/// costs more than a copy: at a robot's rate neither is in the processor's caches.
const SMALL: usize = 1024;

/// The values of a channel.
enum Values {
    F32(Vec<f32>),
    U8(Vec<u8>),
    I32(Vec<i32>),
}

/// Copies of the values given for a channel, for one controller or for a batch of them.
pub struct Staged {
    id: ChannelId,
    name: String,
    shape: Vec<usize>,
    values: Values,
}

impl Staged {
    /// Allocates room for a channel of one controller.
    pub fn of(channel: &Channel<'_>) -> Self {
        Self::with_shape(channel, shape(channel))
    }

    /// Allocates room for a channel of `count` controllers: its shape is `[count, ...]`.
    pub fn batch(channel: &Channel<'_>, count: usize) -> Self {
        let each = shape(channel);
        Self::with_shape(channel, [vec![count], each].concat())
    }

    /// Allocates room for values of another shape than the channel's, such as all draws of noise of
    /// a step.
    pub fn with_shape(channel: &Channel<'_>, shape: Vec<usize>) -> Self {
        let len = shape.iter().product();
        Self {
            id: channel.id(),
            name: channel.name().to_owned(),
            values: match channel.dtype() {
                DType::F32 => Values::F32(vec![0.0; len]),
                DType::U8 => Values::U8(vec![0; len]),
                DType::I32 => Values::I32(vec![0; len]),
            },
            shape,
        }
    }

    /// Returns the channel's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Copies an array.
    pub fn read(&mut self, given: &Bound<'_, PyAny>) -> PyResult<()> {
        let (name, shape) = (&self.name, &self.shape);
        match &mut self.values {
            Values::F32(values) => copy(given, "channel", name, shape, values),
            Values::U8(values) => copy(given, "channel", name, shape, values),
            Values::I32(values) => copy(given, "channel", name, shape, values),
        }
    }

    /// Reads the channel's own values from an array, so that the code and the memory of reading are
    /// in the processor's caches.
    pub fn warm(&mut self, py: Python<'_>) -> PyResult<()> {
        let shape = self.shape.clone();
        let array = match &self.values {
            Values::F32(values) => PyArray1::from_slice(py, values).reshape(shape)?.into_any(),
            Values::U8(values) => PyArray1::from_slice(py, values).reshape(shape)?.into_any(),
            Values::I32(values) => PyArray1::from_slice(py, values).reshape(shape)?.into_any(),
        };
        self.read(&array)
    }

    /// Returns all values of the channel.
    pub fn data(&self) -> (ChannelId, Data<'_>) {
        self.row(0, 1)
    }

    /// Returns the values of row `i` of `count` rows.
    pub fn row(&self, i: usize, count: usize) -> (ChannelId, Data<'_>) {
        fn part<T>(values: &[T], i: usize, count: usize) -> &[T] {
            let len = values.len() / count;
            &values[i * len..(i + 1) * len]
        }
        let data = match &self.values {
            Values::F32(values) => Data::F32(part(values, i, count)),
            Values::U8(values) => Data::U8(part(values, i, count)),
            Values::I32(values) => Data::I32(part(values, i, count)),
        };
        (self.id, data)
    }
}

/// Returns the shape of a channel.
pub fn shape(channel: &Channel<'_>) -> Vec<usize> {
    channel.shape().iter().map(|&dim| dim as usize).collect()
}

/// Reads the values given for the channels: one array if exactly one channel has to be given, or a
/// dictionary by name. `given` marks which of `staged` were given; the first `needed` of them are
/// required.
pub fn read(
    given: &Bound<'_, PyAny>,
    staged: &mut [Staged],
    needed: usize,
    marks: &mut [bool],
) -> PyResult<()> {
    marks.fill(false);
    if needed == 1 && given.is_instance_of::<PyUntypedArray>() {
        marks[0] = true;
        return staged[0].read(given);
    }
    let names = || {
        let names: Vec<_> = staged[..needed].iter().map(Staged::name).collect();
        names.join("`, `")
    };
    let Ok(named) = given.cast::<PyDict>() else {
        let what = if needed == 1 {
            format!("an array, or a dictionary with the channel `{}`", names())
        } else {
            format!("a dictionary with the channels `{}`", names())
        };
        let got = given.get_type().name()?;
        return Err(InputError::new_err(format!(
            "the observation is a {got}; give {what}, of numpy.ndarray"
        )));
    };
    let mut unknown = vec![];
    for (name, _) in named.iter() {
        let name = name
            .extract::<String>()
            .unwrap_or_else(|_| name.to_string());
        if !staged.iter().any(|row| row.name == name) {
            unknown.push(lads_host::instruction::shown(&name));
        }
    }
    let mut missing = vec![];
    for (i, row) in staged.iter().enumerate().take(needed) {
        if !named.contains(&row.name)? {
            missing.push(staged[i].name.clone());
        }
    }
    if !unknown.is_empty() || !missing.is_empty() {
        let mut wrong = vec![];
        if !missing.is_empty() {
            wrong.push(format!("channel `{}` is not given", missing.join("`, `")));
        }
        if !unknown.is_empty() {
            wrong.push(format!("no channel is called `{}`", unknown.join("`, `")));
        }
        return Err(InputError::new_err(format!(
            "the observation: {}; give the channels `{}`",
            wrong.join(", "),
            names()
        )));
    }
    for (row, mark) in staged.iter_mut().zip(marks) {
        if let Some(value) = named.get_item(&row.name)? {
            row.read(&value)?;
            *mark = true;
        }
    }
    Ok(())
}

/// Copies an array of exactly this type and shape; `what` and `name` are for the message.
pub fn copy<T: Element + Copy>(
    given: &Bound<'_, PyAny>,
    what: &str,
    name: &str,
    shape: &[usize],
    into: &mut [T],
) -> PyResult<()> {
    if into.len() <= SMALL {
        let values = checked::<T>(given, what, name, shape)?.to_vec();
        let values =
            values.map_err(|_| InputError::new_err(format!("{what} `{name}`: {}", unaligned())))?;
        into.copy_from_slice(&values);
        return Ok(());
    }
    read_with(given, what, name, shape, |values| {
        into.copy_from_slice(values);
    })
}

/// Lends the values of an array of exactly this type and shape to `work`.
fn read_with<T: Element, R>(
    given: &Bound<'_, PyAny>,
    what: &str,
    name: &str,
    shape: &[usize],
    work: impl FnOnce(&[T]) -> R,
) -> PyResult<R> {
    let array = checked::<T>(given, what, name, shape)?;
    let refused = |why: String| InputError::new_err(format!("{what} `{name}`: {why}"));
    let read = array
        .try_readonly()
        .map_err(|_| refused("the array is being written by other code; give a copy".into()))?;
    let values = read.as_slice().map_err(|_| refused(unaligned()))?;
    Ok(work(values))
}

/// Destination of an answer: an array that the caller gave, or a new one.
pub struct Target<'py> {
    shape: Vec<usize>,
    given: Option<(Bound<'py, PyAny>, PyReadwriteArrayDyn<'py, f32>)>,
}

impl<'py> Target<'py> {
    /// Checks the array given for `out`, which nothing else writes from then on.
    pub fn of(out: Option<Bound<'py, PyAny>>, name: &str, shape: &[usize]) -> PyResult<Self> {
        let given = out.map(|out| Ok::<_, PyErr>((out.clone(), writable(&out, name, shape)?)));
        Ok(Self {
            shape: shape.to_vec(),
            given: given.transpose()?,
        })
    }

    /// Writes the values to the destination; their number matches the shape.
    pub fn put(self, py: Python<'py>, values: &[f32]) -> PyResult<Bound<'py, PyAny>> {
        let Some((out, mut write)) = self.given else {
            let made = PyArray1::from_slice(py, values);
            return Ok(made.reshape(self.shape)?.into_any());
        };
        write
            .as_slice_mut()
            .map_err(|_| InputError::new_err(unaligned()))?
            .copy_from_slice(values);
        Ok(out)
    }
}

/// Returns an array of this type and shape that may be written.
fn writable<'py>(
    given: &Bound<'py, PyAny>,
    name: &str,
    shape: &[usize],
) -> PyResult<PyReadwriteArrayDyn<'py, f32>> {
    let array = checked::<f32>(given, "out", name, shape)?;
    let refused = |why: String| InputError::new_err(format!("out `{name}`: {why}"));
    let mut write = array.try_readwrite().map_err(|error| match error {
        numpy::BorrowError::NotWriteable => {
            refused("the array is read-only; give one that may be written".into())
        }
        _ => refused("the array is in use by other code; give one of its own".into()),
    })?;
    if write.as_slice_mut().is_err() {
        return Err(refused(unaligned()));
    }
    Ok(write)
}

/// Returns all values of an array of this type and rank, and its shape.
pub fn values<T: Element + Copy>(
    given: &Bound<'_, PyAny>,
    name: &str,
    rank: usize,
) -> PyResult<(Vec<usize>, Vec<T>)> {
    let Ok(array) = given.cast::<PyUntypedArray>() else {
        return Err(not_an_array(given, "array", name)?);
    };
    let shape = array.shape().to_vec();
    if shape.len() != rank {
        return Err(InputError::new_err(format!(
            "array `{name}`: its shape is {}; give one of {rank} dimensions",
            tuple(&shape)
        )));
    }
    // Copied from what is known to be there: a shape alone, such as that of a broadcast array, may be larger than the memory.
    let values = read_with(given, "array", name, &shape, <[T]>::to_vec)?;
    Ok((shape, values))
}

fn checked<'a, 'py, T: Element>(
    given: &'a Bound<'py, PyAny>,
    what: &str,
    name: &str,
    shape: &[usize],
) -> PyResult<&'a Bound<'py, PyArrayDyn<T>>> {
    let Ok(array) = given.cast::<PyUntypedArray>() else {
        return Err(not_an_array(given, what, name)?);
    };
    let refused = |why: String| InputError::new_err(format!("{what} `{name}`: {why}"));
    let Ok(typed) = given.cast::<PyArrayDyn<T>>() else {
        let wanted = numpy::dtype::<T>(given.py());
        return Err(refused(format!(
            "its dtype is {}, the contract says {wanted}; give array.astype(numpy.{wanted})",
            array.dtype()
        )));
    };
    if array.shape() != shape {
        return Err(refused(format!(
            "its shape is {}, the contract says {}",
            tuple(array.shape()),
            tuple(shape)
        )));
    }
    if !array.is_c_contiguous() {
        let why = "the array is not contiguous; give numpy.ascontiguousarray(array)";
        return Err(refused(why.into()));
    }
    Ok(typed)
}

fn unaligned() -> String {
    "the array is not aligned; give a copy of it".into()
}

fn not_an_array(given: &Bound<'_, PyAny>, what: &str, name: &str) -> PyResult<PyErr> {
    let got = given.get_type().name()?;
    Ok(InputError::new_err(format!(
        "{what} `{name}`: it is a {got}; give a numpy.ndarray"
    )))
}

/// Formats a shape as Python writes it.
fn tuple(shape: &[usize]) -> String {
    let dims: Vec<_> = shape.iter().map(ToString::to_string).collect();
    match &dims[..] {
        [one] => format!("({one},)"),
        _ => format!("({})", dims.join(", ")),
    }
}

/// Allocates room for everything that a control step may be given: observations first, then noise
/// if the policy takes any.
pub fn stage(contract: &Contract<'_>, noise_len: usize) -> Vec<Staged> {
    let observations = contract.observations().map(|channel| Staged::of(&channel));
    let noise = contract.noise_channel().filter(|_| noise_len > 0);
    let noise = noise.map(|channel| Staged::with_shape(&channel, vec![noise_len]));
    observations.chain(noise).collect()
}

/// Returns the channels that were given.
pub fn given<'s>(staged: &'s [Staged], given: &[bool]) -> Vec<(ChannelId, Data<'s>)> {
    let marked = staged.iter().zip(given).filter(|(_, given)| **given);
    marked.map(|(row, _)| row.data()).collect()
}
