//! Controller for Python: one step after another, in memory that was allocated once.
//!
//! Inputs are copied while the interpreter is held, the step runs without it, and results are
//! copied again, so other threads may change their arrays at any time. Two threads in one
//! controller at once are refused, not queued: a control loop that waits for another is a mistake.

use std::sync::{Arc, Mutex, MutexGuard, TryLockError};

use lads_core::{Data, Decision, Instruction, Isa, Noise};
use numpy::{PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyString;

use crate::arrays::{self, Staged, Target};
use crate::cell::{Checked, Working};
use crate::errors::{self, BusyError, ClosedError, InstructionError, StepError, WorkspaceError};
use crate::numbers;
use crate::policy::Policy;
use crate::process::Process;
use crate::report::StepReport;

/// Settings of a controller, besides its instruction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Seed of sampling.
    pub sample: Option<u64>,
    /// Seed of the noise.
    pub noise: Option<u64>,
    /// True if the controller runs on the kernels that every processor has.
    pub portable: bool,
}

impl Settings {
    /// Makes a fresh controller with these settings.
    pub fn working(self, policy: &Arc<Checked>) -> PyResult<Working> {
        let isa = if self.portable {
            Isa::portable()
        } else {
            Isa::detect()
        };
        let mut working =
            Working::of(policy, isa).map_err(|error| WorkspaceError::new_err(error.to_string()))?;
        working.with(|controller| {
            if let Some(seed) = self.sample {
                controller.set_decision(policy.view().contract().sampling(seed));
            }
            if let Some(seed) = self.noise {
                controller.set_noise(Noise::Seeded { seed });
            }
        });
        Ok(working)
    }
}

/// Instruction that a policy is given.
pub enum Told {
    /// Number of a known instruction.
    Known(u32),
    /// Word embeddings [words, dim].
    Words(Vec<f32>),
}

impl Told {
    /// Reads the id or the text of a known instruction, or an array of word embeddings [words,
    /// dim].
    pub fn of(policy: &Checked, given: &Bound<'_, PyAny>) -> PyResult<Self> {
        let contract = policy.view().contract();
        if let Ok(text) = given.cast::<PyString>() {
            // A text with half a surrogate pair is no instruction's.
            let found = policy.opened().instruction(&text.to_string_lossy());
            return match found {
                Ok(id) => Ok(Self::Known(id)),
                Err(error) => Err(InstructionError::new_err(error.to_string())),
            };
        }
        let (shape, words) = arrays::values(given, "instruction", 2).map_err(|error| {
            let text = error.value(given.py()).to_string();
            InstructionError::new_err(format!(
                "{text}; or give the id or the text of a known instruction"
            ))
        })?;
        if contract.instruction_channel().is_some() && shape[1] != contract.word_dim() {
            return Err(InstructionError::new_err(format!(
                "the words have {} elements each, the contract says {}; use the encoder that policy.contract.language names",
                shape[1],
                contract.word_dim()
            )));
        }
        Ok(Self::Words(words))
    }

    /// Returns the instruction in the controller's form.
    pub fn as_instruction(&self) -> Instruction<'_> {
        match self {
            Self::Known(id) => Instruction::Id(*id),
            Self::Words(words) => Instruction::Words(words),
        }
    }
}

/// The running controller, with buffers for its inputs and outputs.
struct Inner {
    working: Working,
    staged: Vec<Staged>,
    given: Vec<bool>,
    /// Number of the staged channels that are required.
    needed: usize,
    action: Vec<f32>,
    told: Option<Told>,
}

impl Inner {
    /// Reads the values given for the channels.
    fn read(&mut self, observation: &Bound<'_, PyAny>) -> PyResult<()> {
        arrays::read(observation, &mut self.staged, self.needed, &mut self.given)
    }
}

/// A policy at work: one observation in, one action out, once every control period.
///
/// It belongs to one thread at a time and to the process that made it. Made by Policy.controller.
#[pyclass(frozen, module = "lads")]
pub struct Controller {
    policy: Py<Policy>,
    checked: Arc<Checked>,
    settings: Settings,
    process: Process,
    inner: Mutex<Option<Inner>>,
}

impl Controller {
    /// Makes a fresh controller without an instruction.
    pub fn of(policy: &Bound<'_, Policy>, settings: Settings) -> PyResult<Self> {
        let checked = Arc::clone(policy.get().checked());
        let view = checked.view();
        let staged = arrays::stage(view.contract(), view.noise_len());
        let inner = Inner {
            working: settings.working(&checked)?,
            given: vec![false; staged.len()],
            needed: view.contract().observations_len(),
            staged,
            action: vec![0.0; view.contract().action_len()],
            told: None,
        };
        Ok(Self {
            policy: policy.clone().unbind(),
            checked,
            settings,
            process: Process::current(),
            inner: Mutex::new(Some(inner)),
        })
    }

    /// Returns the settings of the controller.
    pub fn settings(&self) -> Settings {
        self.settings
    }

    /// Returns the policy of the controller.
    pub fn checked(&self) -> &Arc<Checked> {
        &self.checked
    }

    /// Describes the rule that picks indices.
    pub fn rule(&self) -> String {
        let rule = match self.settings.sample {
            Some(seed) => self.contract().sampling(seed),
            None => self.contract().decision(),
        };
        match rule {
            Decision::Argmax => "argmax".into(),
            Decision::Sample { temperature, .. } => {
                format!("sampling at temperature {temperature}")
            }
        }
    }

    fn lock(&self) -> PyResult<MutexGuard<'_, Option<Inner>>> {
        self.process.check("controller", "policy.controller(...)")?;
        match self.inner.try_lock() {
            Ok(guard) => Ok(guard),
            Err(TryLockError::WouldBlock) => Err(BusyError::new_err(
                "the controller is at work in another thread; give each thread one of its own, by policy.controller(...)",
            )),
            Err(TryLockError::Poisoned(_)) => Err(StepError::new_err(
                "the controller failed before; make another by policy.controller(...)",
            )),
        }
    }

    fn work<R>(&self, work: impl FnOnce(&mut Inner) -> PyResult<R>) -> PyResult<R> {
        let mut guard = self.lock()?;
        let inner = guard.as_mut().ok_or_else(|| {
            ClosedError::new_err("the controller is closed; make another by policy.controller(...)")
        })?;
        work(inner)
    }

    fn contract(&self) -> &lads_core::Contract<'_> {
        self.checked.view().contract()
    }
}

#[pymethods]
impl Controller {
    /// Runs one control step: returns the action, float32 [actions], for the observation, both in
    /// the contract's units, and a lads.StepReport.
    ///
    /// `observation` is an array of exactly the channel's dtype and shape, contiguous; for a policy
    /// with several channels a dictionary of arrays by the channels' names, to which the noise
    /// channel may be added. With `out`, the action is written there and `out` is returned; for a
    /// policy of one channel only the report is allocated then. An observation that is refused
    /// leaves the controller unchanged.
    #[pyo3(signature = (observation, out=None))]
    fn step<'py>(
        &self,
        py: Python<'py>,
        observation: &Bound<'py, PyAny>,
        out: Option<Bound<'py, PyAny>>,
    ) -> PyResult<(Bound<'py, PyAny>, StepReport)> {
        self.work(|inner| {
            inner.read(observation)?;
            let target = Target::of(out, "action", &[inner.action.len()])?;
            let Inner {
                working,
                staged,
                given,
                action,
                ..
            } = &mut *inner;
            let report = py.detach(|| {
                let only = [staged[0].data()];
                let (all, inputs);
                inputs = if staged.len() == 1 {
                    &only[..]
                } else {
                    all = arrays::given(staged, given);
                    &all[..]
                };
                working.with(|controller| match *inputs {
                    [(_, Data::F32(values))] if staged.len() == 1 => {
                        controller.step(values, action)
                    }
                    _ => controller.step_with(inputs, action),
                })
            });
            let report = report.map_err(|error| errors::step(&error, self.contract()))?;
            Ok((target.put(py, action)?, report.into()))
        })
    }

    /// Sets the instruction to follow from the next step on, as a new episode: the id or the text
    /// of a known one, or word embeddings, float32 [words, dim]. An instruction that is refused
    /// changes nothing.
    pub fn instruct(&self, py: Python<'_>, instruction: &Bound<'_, PyAny>) -> PyResult<()> {
        self.work(|inner| {
            let told = Told::of(&self.checked, instruction)?;
            let working = &mut inner.working;
            let done = py.detach(|| {
                working.with(|controller| controller.set_instruction(told.as_instruction()))
            });
            done.map_err(|error| errors::instruction(&error))?;
            inner.told = Some(told);
            Ok(())
        })
    }

    /// Starts a new episode with the same instruction. Sampling and noise continue where they were.
    fn reset(&self) -> PyResult<()> {
        self.work(|inner| {
            inner.working.with(|controller| controller.reset());
            Ok(())
        })
    }

    /// Tells which action was executed since the last step, if it is not the one that the step
    /// returned: float32 [actions].
    fn executed(&self, action: &Bound<'_, PyAny>) -> PyResult<()> {
        self.work(|inner| {
            let mut done = vec![0.0; inner.action.len()];
            arrays::copy(action, "action", "executed", &[done.len()], &mut done)?;
            let told = inner.working.with(|controller| controller.executed(&done));
            told.map_err(|error| errors::step(&error, self.contract()))
        })
    }

    /// Returns the action, float32 [actions], for an observation and an index that the caller
    /// chose; changes nothing in the episode.
    #[pyo3(signature = (observation, index, out=None))]
    fn follow<'py>(
        &self,
        py: Python<'py>,
        observation: &Bound<'py, PyAny>,
        index: &Bound<'py, PyAny>,
        out: Option<Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let index = numbers::whole(index, "index", 0, u64::from(u32::MAX))? as u32;
        self.work(|inner| {
            inner.read(observation)?;
            let target = Target::of(out, "action", &[inner.action.len()])?;
            let Inner {
                working,
                staged,
                given,
                action,
                ..
            } = &mut *inner;
            let done = py.detach(|| {
                let inputs = arrays::given(staged, given);
                working.with(|controller| controller.follow(&inputs, index, action))
            });
            done.map_err(|error| match error {
                lads_core::FollowError::Input(error) => {
                    errors::input(lads_host::refused(&error, self.contract()))
                }
                other => StepError::new_err(other.to_string()),
            })?;
            target.put(py, action)
        })
    }

    /// Brings code, weights and caches into the processor's caches; call it right before the first
    /// step or after a pause, such as a millisecond before a step is due.
    fn warm(&self, py: Python<'_>) -> PyResult<()> {
        self.work(|inner| {
            let working = &mut inner.working;
            py.detach(|| working.with(|controller| controller.warm()));
            // What a step does besides, with arrays of its own: the next one reads all of it anew.
            for row in &mut inner.staged[..inner.needed] {
                row.warm(py)?;
            }
            let shape = [inner.action.len()];
            let out = PyArray1::from_slice(py, &inner.action).into_any();
            Target::of(Some(out), "action", &shape)?.put(py, &inner.action)?;
            let report = lads_core::StepReport {
                timestep: 0,
                selected: None,
            };
            Py::new(py, StepReport::from(report)).map(drop)
        })
    }

    /// Frees the controller's memory; all later calls are refused.
    fn close(&self) -> PyResult<()> {
        *self.lock()? = None;
        Ok(())
    }

    /// Returns whether the controller is closed.
    #[getter]
    fn closed(&self) -> PyResult<bool> {
        Ok(self.lock()?.is_none())
    }

    /// Returns the scores of the last selection, one per index: float32 [indices]; empty for a
    /// policy that selects nothing.
    #[getter]
    fn scores<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f32>>> {
        self.work(|inner| {
            let scores = |controller: &mut lads_core::Controller<'_, '_>| {
                PyArray1::from_slice(py, controller.scores())
            };
            Ok(inner.working.with(scores))
        })
    }

    /// Returns the action of the last step, or the one that `executed` reported: float32 [actions].
    #[getter]
    fn last_action<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f32>>> {
        self.work(|inner| {
            let action = |controller: &mut lads_core::Controller<'_, '_>| {
                PyArray1::from_slice(py, controller.last_action())
            };
            Ok(inner.working.with(action))
        })
    }

    /// Returns the id of the known instruction that the controller follows; None for word
    /// embeddings or without one.
    #[getter]
    fn instruction(&self) -> PyResult<Option<String>> {
        self.work(|inner| {
            let Some(Told::Known(id)) = inner.told else {
                return Ok(None);
            };
            let known = self.contract().instruction(id as usize);
            Ok(known.map(|known| known.id.to_owned()))
        })
    }

    /// Returns the last argument of `instruct`: the id of a known one, word embeddings, or None.
    #[getter(_instruction)]
    fn told<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        if let Some(id) = self.instruction()? {
            return Ok(Some(PyString::new(py, &id).into_any()));
        }
        self.work(|inner| {
            let Some(Told::Words(words)) = &inner.told else {
                return Ok(None);
            };
            let dim = self.contract().word_dim().max(1);
            let array = PyArray1::from_slice(py, words).reshape([words.len() / dim, dim])?;
            Ok(Some(array.into_any()))
        })
    }

    /// Returns whether an instruction is set, or the policy takes none.
    #[getter]
    fn instructed(&self) -> PyResult<bool> {
        self.work(|inner| Ok(inner.working.with(|controller| controller.is_instructed())))
    }

    /// Returns the rule that picks indices: 'argmax' or 'sample'.
    #[getter]
    fn decision(&self) -> PyResult<&'static str> {
        self.work(|inner| {
            Ok(inner
                .working
                .with(|controller| match controller.decision() {
                    Decision::Argmax => "argmax",
                    Decision::Sample { .. } => "sample",
                }))
        })
    }

    /// Returns the processor's instruction set that the controller runs on: 'portable', 'avx2' or
    /// 'avx512'.
    #[getter]
    fn isa(&self) -> PyResult<&'static str> {
        self.work(|inner| Ok(inner.working.with(|controller| controller.isa().name())))
    }

    /// Returns the policy of the controller.
    #[getter]
    fn policy(&self, py: Python<'_>) -> Py<Policy> {
        self.policy.clone_ref(py)
    }

    /// Returns the keyword arguments that Policy.controller was given, without the instruction.
    #[getter(_settings)]
    fn keywords(&self) -> (Option<u64>, Option<u64>, bool) {
        let Settings {
            sample,
            noise,
            portable,
        } = self.settings;
        (sample, noise, portable)
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, _exception: &Bound<'_, PyAny>) -> PyResult<()> {
        self.close()
    }

    fn __repr__(&self) -> String {
        let policy = self.policy.get().__repr__();
        format!("<lads.Controller of {policy}>")
    }
}
