//! Opens policies, and describes opened ones.

use std::path::PathBuf;
use std::sync::Arc;

use lads_compiler::{Bundle, CacheFormat, Formats, Options, WeightFormat};
use lads_core::{Data, Isa, similarity};
use lads_host::Opened;
use numpy::{PyArray1, PyArrayDyn, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyBytes, PyDict, PyTuple};

use crate::arrays;
use crate::cell::{Checked, Working};
use crate::controller::{Controller, Settings, Told};
use crate::errors::{self, InstructionError, OpenError, SelfTestError, WorkspaceError, opening};
use crate::numbers;

/// A policy that was read and checked. It never changes and may be used by any number of threads.
#[pyclass(frozen, module = "lads")]
pub struct Policy {
    path: PathBuf,
    checked: Arc<Checked>,
    notes: Vec<String>,
    contract: PyOnceLock<Py<PyAny>>,
}

/// Opens a policy, a bundle (.onnx), which is compiled on the way, or a compiled image (.lads).
///
/// `weights` and `low_level` are 'f32', 'f16', 'bf16', 'int16' or 'int8', `cache` is 'f32', 'f16' or
/// 'int8'. Without `weights`, formats that are left out are as the bundle was tuned
/// (`lads-run tune`), or 'f32' if it was not tuned; with it, `low_level` defaults to `weights` and
/// `cache` to 'f32'. Fewer bits have to pass the gate: the golden episode replays with the same
/// indices and with actions inside `tolerance` (in the action's units); with `force` they need not.
#[pyfunction]
#[pyo3(signature = (path, *, weights=None, low_level=None, cache=None, tolerance=None, force=false))]
pub fn open(
    py: Python<'_>,
    path: PathBuf,
    weights: Option<&str>,
    low_level: Option<&str>,
    cache: Option<&str>,
    tolerance: Option<Bound<'_, PyAny>>,
    force: bool,
) -> PyResult<Policy> {
    let tolerance = tolerance
        .map(|given| {
            let given = numbers::real::<OpenError>(&given, "tolerance")? as f32;
            if given.is_finite() && given > 0.0 {
                return Ok(given);
            }
            Err(OpenError::new_err(
                "tolerance: it has to be a positive number of 32 bits; give the largest difference of an action that is accepted",
            ))
        })
        .transpose()?;
    let weight = |what, name: Option<&str>| {
        let found = name.map(|name| format(what, name, WeightFormat::ALL, WeightFormat::name));
        found.transpose()
    };
    let caches = |name| format("cache", name, CacheFormat::ALL, CacheFormat::name);
    let formats = Formats {
        weights: weight("weights", weights)?,
        low_level: weight("low_level", low_level)?,
        cache: cache.map(caches).transpose()?,
    };
    let opened = py.detach(|| {
        // A file that is not a bundle is refused below, with its actual kind.
        let asked = formats != Formats::default();
        let bundle = asked.then(|| Bundle::open(&path).ok()).flatten();
        let storage = bundle.map(|bundle| formats.storage(&bundle)).transpose()?;
        let options = Options {
            storage: storage.flatten(),
            tolerance,
            force,
        };
        let opened = lads_host::open_with(&path, &options);
        Ok((options, opened))
    });
    let (options, opened) = opened.map_err(|error: lads_compiler::BundleError| {
        OpenError::new_err(format!("{}: {error}", path.display()))
    })?;
    let opened = opened.map_err(|error| opening(&error))?;
    let asked = formats != Formats::default() || options != Options::default();
    if asked && !opened.is_bundle() {
        return Err(OpenError::new_err(format!(
            "{}: it is a compiled image already; give the bundle (.onnx)",
            path.display()
        )));
    }
    Ok(Policy::of(path, opened))
}

/// Opens a policy from the bytes of its image, such as Policy.image; `path` names it in messages.
/// Unpickling calls this function.
#[pyfunction]
pub fn from_image(py: Python<'_>, image: &[u8], path: PathBuf) -> PyResult<Policy> {
    let opened = py.detach(|| lads_host::from_bytes(image));
    let opened = opened.map_err(|error| {
        opening(&lads_host::OpenError {
            path: Some(path.clone()),
            ..error
        })
    })?;
    Ok(Policy::of(path, opened))
}

/// Returns the format with this name.
fn format<T: Copy, const N: usize>(
    what: &str,
    name: &str,
    known: [T; N],
    name_of: fn(T) -> &'static str,
) -> PyResult<T> {
    let found = known.into_iter().find(|&format| name_of(format) == name);
    found.ok_or_else(|| {
        OpenError::new_err(format!(
            "{what} '{}': no such format; known are {}",
            lads_host::instruction::shown(name),
            known.map(name_of).join(", ")
        ))
    })
}

impl Policy {
    /// Makes a policy that was read from a file, or made of it.
    pub fn of(path: PathBuf, opened: Opened) -> Self {
        Self {
            path,
            checked: Checked::of(opened),
            notes: vec![],
            contract: PyOnceLock::new(),
        }
    }

    /// Adds notes on how the policy was made.
    pub fn with_notes(self, notes: Vec<String>) -> Self {
        Self { notes, ..self }
    }

    /// Returns the checked policy.
    pub fn checked(&self) -> &Arc<Checked> {
        &self.checked
    }

    /// Makes a fresh controller on the widest instruction set.
    fn working(&self) -> PyResult<Working> {
        Working::of(&self.checked, Isa::detect())
            .map_err(|error| WorkspaceError::new_err(error.to_string()))
    }

    fn report(&self) -> String {
        lads_cli::inspect_json(&self.path, self.checked.opened()).to_string()
    }
}

#[pymethods]
impl Policy {
    /// Returns the path of the file that the policy was read from.
    #[getter]
    pub fn path(&self) -> String {
        self.path.display().to_string()
    }

    /// Returns the compiled image, which `lads compile` writes: bytes.
    #[getter]
    fn image<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, self.checked.opened().image())
    }

    /// Returns the policy's contract, as a lads.Contract.
    #[getter]
    fn contract(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let read = self.contract.get_or_try_init(py, || {
            let module = py.import("lads.contract")?;
            let read = module.call_method1("read", (self.report(),))?;
            Ok::<_, PyErr>(read.unbind())
        })?;
        Ok(read.clone_ref(py))
    }

    /// Returns the notes of an import, a line each: tuple of str; empty for a policy that was
    /// opened.
    #[getter]
    fn notes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        PyTuple::new(py, &self.notes)
    }

    /// Returns the report of `lads inspect --json`: channels, schedule, programs, states, sizes in
    /// bytes.
    fn inspect<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        py.import("json")?.call_method1("loads", (self.report(),))
    }

    /// Returns the recorded episode that the self-test replays, as a lads.Golden; None for a policy
    /// without one.
    #[getter]
    fn golden<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let view = self.checked.view();
        let Some(golden) = view.golden() else {
            return Ok(None);
        };
        let contract = view.contract();
        let steps = golden.len();
        let observations = PyDict::new(py);
        for (place, channel) in contract.observations().enumerate() {
            let mut shape = arrays::shape(&channel);
            shape.insert(0, steps);
            let rows: Vec<_> = golden.steps().collect();
            let all = rows
                .iter()
                .filter_map(|step| step.observations().get(place));
            let (mut floats, mut bytes, mut integers) = (vec![], vec![], vec![]);
            for (_, data) in all {
                match data {
                    Data::F32(values) => floats.extend_from_slice(values),
                    Data::U8(values) => bytes.extend_from_slice(values),
                    Data::I32(values) => integers.extend_from_slice(values),
                }
            }
            let array = match channel.dtype() {
                lads_core::DType::F32 => shaped(py, &floats, &shape)?.into_any(),
                lads_core::DType::U8 => shaped(py, &bytes, &shape)?.into_any(),
                lads_core::DType::I32 => shaped(py, &integers, &shape)?.into_any(),
            };
            observations.set_item(channel.name(), array)?;
        }
        let selected: Vec<_> = golden.steps().filter_map(|step| step.selected).collect();
        let noise: Vec<_> = golden
            .steps()
            .flat_map(|step| step.noise.to_vec())
            .collect();
        let actions: Vec<_> = golden
            .steps()
            .flat_map(|step| step.action.to_vec())
            .collect();
        let instruction = golden
            .instruction()
            .and_then(|id| contract.instruction(id as usize))
            .map(|known| known.id);
        let fields = PyDict::new(py);
        fields.set_item("instruction", instruction)?;
        fields.set_item("observations", observations)?;
        fields.set_item("noise", shaped(py, &noise, &[steps, view.noise_len()])?)?;
        let some = (!selected.is_empty()).then(|| PyArray1::from_slice(py, &selected));
        fields.set_item("selected", some)?;
        let len = contract.action_len();
        fields.set_item("actions", shaped(py, &actions, &[steps, len])?)?;
        fields.set_item("tolerance", golden.tolerance())?;
        let class = py.import("lads.contract")?.getattr("Golden")?;
        class.call((), Some(&fields)).map(Some)
    }

    /// Returns the word embeddings of a known instruction, by its id or text: float32 [words, dim].
    fn words<'py>(
        &self,
        py: Python<'py>,
        instruction: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let contract = self.checked.view().contract();
        let Told::Known(id) = Told::of(&self.checked, instruction)? else {
            return Err(InstructionError::new_err(
                "words takes the id or the text of a known instruction; policy.contract.instructions lists them",
            ));
        };
        let known = contract.instruction(id as usize);
        let words = known.map_or(&[][..], |known| known.words);
        let dim = contract.word_dim();
        shaped(py, words, &[words.len() / dim.max(1), dim])
    }

    /// Finds the known instruction that word embeddings float32 [words, dim] are most similar to ->
    /// lads.Nearest.
    ///
    /// A policy follows any words, nonsense too: follow only what is `accepted`, at the similarity
    /// that the contract asks for.
    fn nearest<'py>(
        &self,
        py: Python<'py>,
        words: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let contract = self.checked.view().contract();
        let Told::Words(words) = Told::of(&self.checked, words)? else {
            return Err(InstructionError::new_err(
                "nearest compares word embeddings; give an array float32 [words, dim], as lads.language.Encoder makes it",
            ));
        };
        let checked = contract.check_words(&words);
        checked.map_err(|error| errors::instruction(&error))?;
        let found = py.detach(|| {
            let known = contract.instructions().map(|known| known.words);
            similarity::nearest(&words, known, contract.word_dim())
        });
        let Some((place, alike)) = found else {
            return Err(InstructionError::new_err(
                "the policy knows no instruction that words could be compared with; give none",
            ));
        };
        let known = self.contract(py)?.getattr(py, "instructions")?;
        let known = known.bind(py).get_item(place)?;
        let class = py.import("lads.contract")?.getattr("Nearest")?;
        class.call1((known, f64::from(alike), alike >= contract.acceptance()))
    }

    /// Replays the golden episode on this machine and compares the indices in force and the actions -> lads.SelfTest.
    fn self_test<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let view = self.checked.view();
        let path = self.path.display();
        let Some(golden) = view.golden() else {
            return Err(SelfTestError::new_err(format!(
                "{path}: it carries no golden episode, so nothing can be tested; export the bundle with one"
            )));
        };
        let mut working = self.working()?;
        let test = py.detach(|| working.with(|controller| controller.self_test()));
        let test = test.map_err(|error| {
            SelfTestError::new_err(format!(
                "{path}: the self-test failed: {error}; do not run it on this machine; export and compile it again"
            ))
        })?;
        let class = py.import("lads.contract")?.getattr("SelfTest")?;
        class.call1((
            test.steps,
            f64::from(test.largest_error),
            f64::from(golden.tolerance()),
            format!("{:08x}", test.digest),
        ))
    }

    /// Makes a fresh controller with memory of its own.
    ///
    /// `instruction` is the id or the text of a known one, or word embeddings float32 [words, dim];
    /// None for a policy that takes none, or to set it later. `sample` is a seed: indices are
    /// sampled instead of following the contract's rule. `noise` is a seed: standard normals for
    /// the noise channel instead of the contract's rule. `portable` runs on the kernels that every
    /// processor has, with the same bits.
    #[pyo3(signature = (instruction=None, *, sample=None, noise=None, portable=false))]
    fn controller(
        slf: &Bound<'_, Self>,
        instruction: Option<Bound<'_, PyAny>>,
        sample: Option<Bound<'_, PyAny>>,
        noise: Option<Bound<'_, PyAny>>,
        portable: bool,
    ) -> PyResult<Controller> {
        let settings = Settings {
            sample: numbers::seed(sample.as_ref(), "sample")?,
            noise: numbers::seed(noise.as_ref(), "noise")?,
            portable,
        };
        let controller = Controller::of(slf, settings)?;
        if let Some(instruction) = instruction {
            controller.instruct(slf.py(), &instruction)?;
        }
        Ok(controller)
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let py = slf.py();
        let from_image = py.import("lads._lads")?.getattr("from_image")?;
        let this = slf.get();
        let arguments = (this.image(py), this.path()).into_pyobject(py)?;
        Ok((from_image, arguments.into_any()))
    }

    pub fn __repr__(&self) -> String {
        let contract = self.checked.view().contract();
        format!(
            "<lads.Policy '{}': {}, {}>",
            self.path.display(),
            contract.family(),
            contract.environment_id()
        )
    }
}

/// Returns values as an array of this shape.
fn shaped<'py, T: numpy::Element + Copy>(
    py: Python<'py>,
    values: &[T],
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    PyArray1::from_slice(py, values).reshape(shape)
}
