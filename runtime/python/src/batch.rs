//! Steps a batch of controllers of one policy over threads: many observations in, as many actions
//! out.
//!
//! All observations are checked before the first controller steps, so that a refusal leaves all
//! controllers unchanged. The threads ([`Crew`]) are the batch's own, started once.

use std::num::NonZero;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};
use std::thread;

use lads_core::StepReport;
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyList, PyTuple, PyType};

use crate::arrays::{self, Staged, Target};
use crate::cell::Checked;
use crate::controller::{Settings, Told};
use crate::crew::{Broken, Crew, Row};
use crate::errors::{self, BusyError, ClosedError, InputError, StepError, WorkspaceError};
use crate::memory;
use crate::numbers;
use crate::policy::Policy;
use crate::process::Process;

struct Inner {
    /// Controllers and threads; not dropped in a forked child, which has none of its threads.
    crew: Crew,
    given: Vec<bool>,
    actions: Vec<f32>,
    reports: Vec<StepReport>,
}

/// Controllers of one policy, stepped together over threads.
#[pyclass(frozen, module = "lads.vector")]
pub struct Controllers {
    policy: Py<Policy>,
    checked: Arc<Checked>,
    process: Process,
    count: usize,
    threads: usize,
    inner: Mutex<Option<Inner>>,
}

impl Drop for Controllers {
    fn drop(&mut self) {
        if self.process.is_current() {
            return;
        }
        let inner = self.inner.get_mut().unwrap_or_else(PoisonError::into_inner);
        if let Some(Inner { crew, .. }) = inner.take() {
            std::mem::forget(crew);
        }
    }
}

impl Controllers {
    fn lock(&self) -> PyResult<MutexGuard<'_, Option<Inner>>> {
        self.process.check(
            "batch of controllers",
            "lads.vector.Controllers(policy, ...)",
        )?;
        match self.inner.try_lock() {
            Ok(guard) => Ok(guard),
            Err(TryLockError::WouldBlock) => Err(BusyError::new_err(
                "the batch is at work in another thread; give each thread one of its own",
            )),
            Err(TryLockError::Poisoned(_)) => Err(broken(Broken)),
        }
    }

    fn work<R>(&self, work: impl FnOnce(&mut Inner) -> PyResult<R>) -> PyResult<R> {
        let mut guard = self.lock()?;
        let inner = guard
            .as_mut()
            .ok_or_else(|| ClosedError::new_err("the batch is closed; make another"))?;
        work(inner)
    }

    fn contract(&self) -> &lads_core::Contract<'_> {
        self.checked.view().contract()
    }
}

#[pymethods]
impl Controllers {
    /// Makes `count` controllers of a policy, with `threads` threads, of which the caller's is one
    /// (all of the machine's by default, never more than controllers). `instruction` is one for
    /// all, or a list with one for each. The seed of row i is `sample + i` and `noise + i`.
    #[new]
    #[pyo3(signature = (policy, count, instruction=None, *, threads=None, sample=None, noise=None, portable=false))]
    fn new(
        policy: &Bound<'_, Policy>,
        count: &Bound<'_, PyAny>,
        instruction: Option<Bound<'_, PyAny>>,
        threads: Option<Bound<'_, PyAny>>,
        sample: Option<Bound<'_, PyAny>>,
        noise: Option<Bound<'_, PyAny>>,
        portable: bool,
    ) -> PyResult<Self> {
        let most = u64::from(u32::MAX);
        let checked = Arc::clone(policy.get().checked());
        let view = checked.view();
        let contract = view.contract();
        let count = numbers::whole(count, "count", 1, u64::MAX)?;
        memory::afford(view, count)?;
        let count = count as usize;
        let threads = threads
            .map(|threads| numbers::whole(&threads, "threads", 1, most))
            .transpose()?;
        let sample = numbers::seed(sample.as_ref(), "sample")?;
        let noise = numbers::seed(noise.as_ref(), "noise")?;
        let rows = (0..count as u64).map(|row| {
            let seed = |seed: Option<u64>| seed.map(|seed| seed.wrapping_add(row));
            let settings = Settings {
                sample: seed(sample),
                noise: seed(noise),
                portable,
            };
            Ok(Row::new(settings.working(&checked)?, contract.action_len()))
        });
        let rows = rows.collect::<PyResult<Vec<_>>>()?;
        let staged = contract.observations();
        let staged: Vec<_> = staged
            .map(|channel| Staged::batch(&channel, count))
            .collect();
        let all = || thread::available_parallelism().map_or(1, NonZero::get);
        let threads = threads.map_or_else(all, |threads| threads as usize);
        let threads = threads.min(count);
        let inner = Inner {
            given: vec![false; staged.len()],
            crew: Crew::start(rows, staged, threads).map_err(|error| {
                WorkspaceError::new_err(format!(
                    "the threads cannot be started ({error}); ask for fewer"
                ))
            })?,
            actions: vec![0.0; count * contract.action_len()],
            reports: Vec::with_capacity(count),
        };
        let batch = Self {
            policy: policy.clone().unbind(),
            checked,
            process: Process::current(),
            count,
            threads,
            inner: Mutex::new(Some(inner)),
        };
        if let Some(instruction) = instruction {
            batch.instruct(policy.py(), &instruction, None)?;
        }
        Ok(batch)
    }

    /// Runs one control step of all controllers: returns the actions, float32 [count, actions], and
    /// a lads.vector.Report.
    ///
    /// `observations` is an array [count, ...] of the channel's dtype, contiguous, or a dictionary of them by the channels' names. With
    /// `out`, the actions are written there.
    #[pyo3(signature = (observations, out=None))]
    fn step<'py>(
        &self,
        py: Python<'py>,
        observations: &Bound<'py, PyAny>,
        out: Option<Bound<'py, PyAny>>,
    ) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        self.work(|inner| {
            let (count, len) = (self.count, self.contract().action_len());
            let Inner {
                crew,
                given,
                actions,
                reports,
            } = &mut *inner;
            let needed = given.len();
            arrays::read(observations, &mut crew.order().staged, needed, given)?;
            let target = Target::of(out, "actions", &[count, len])?;
            let contract = self.contract();
            let mut failed = vec![];
            let refused = py.detach(|| {
                let refused = crew.refused(|inputs| contract.check_observations(inputs));
                if refused.is_empty() {
                    reports.clear();
                    crew.step(|i, row| {
                        actions[i * len..(i + 1) * len].copy_from_slice(&row.action);
                        reports.push(row.report);
                        failed.extend(row.failed.map(|error| (i, error)));
                    })?;
                }
                Ok(refused)
            });
            let refused = refused.map_err(broken)?;
            if !refused.is_empty() {
                let rows = refused
                    .iter()
                    .map(|(i, error)| format!("row {i}: {}", lads_host::refused(error, contract)));
                return Err(errors::input(rows.collect::<Vec<_>>().join(", ")));
            }
            if let Some((_, first)) = failed.first() {
                let rows: Vec<_> = failed.iter().map(|(i, _)| i.to_string()).collect();
                let error = errors::step(first, contract);
                let text = format!(
                    "rows {}: {}; the other rows have stepped",
                    rows.join(", "),
                    error.value(py)
                );
                return Err(PyErr::from_type(error.get_type(py), text));
            }
            Ok((target.put(py, actions)?, report(py, reports)?))
        })
    }

    /// Sets an instruction: one for all rows, or a list of one for each of `rows` (all by default).
    /// If one is refused, the rows before it follow theirs.
    #[pyo3(signature = (instruction, rows=None))]
    fn instruct(
        &self,
        py: Python<'_>,
        instruction: &Bound<'_, PyAny>,
        rows: Option<Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let chosen = numbers::rows(rows.as_ref(), self.count)?;
        let told =
            if instruction.is_instance_of::<PyList>() || instruction.is_instance_of::<PyTuple>() {
                let each = instruction.try_iter()?.collect::<PyResult<Vec<_>>>()?;
                if each.len() != chosen.len() {
                    return Err(InputError::new_err(format!(
                        "{} instructions for {} rows; give one for all or one for each",
                        each.len(),
                        chosen.len()
                    )));
                }
                let told = each.iter().map(|one| Told::of(&self.checked, one));
                told.collect::<PyResult<Vec<_>>>()?
            } else {
                vec![Told::of(&self.checked, instruction)?]
            };
        self.work(|inner| {
            let crew = &inner.crew;
            let done = py.detach(|| {
                for (place, &row) in chosen.iter().enumerate() {
                    let told = &told[place.min(told.len() - 1)];
                    let done = crew
                        .row(row)?
                        .working
                        .with(|controller| controller.set_instruction(told.as_instruction()));
                    if done.is_err() {
                        return Ok(done);
                    }
                }
                Ok(Ok(()))
            });
            done.map_err(broken)?
                .map_err(|error| errors::instruction(&error))
        })
    }

    /// Starts new episodes in `rows`, all by default.
    #[pyo3(signature = (rows=None))]
    fn reset(&self, rows: Option<Bound<'_, PyAny>>) -> PyResult<()> {
        let chosen = numbers::rows(rows.as_ref(), self.count)?;
        self.work(|inner| {
            for row in chosen {
                let mut row = inner.crew.row(row).map_err(broken)?;
                row.working.with(|controller| controller.reset());
            }
            Ok(())
        })
    }

    /// Tells which actions were executed in all rows: float32 [count, actions]. If one is refused,
    /// such as that of a row without a step, the rows before it have been told.
    fn executed(&self, actions: &Bound<'_, PyAny>) -> PyResult<()> {
        self.work(|inner| {
            let len = self.contract().action_len();
            let mut done = vec![0.0; self.count * len];
            arrays::copy(
                actions,
                "actions",
                "executed",
                &[self.count, len],
                &mut done,
            )?;
            for (i, done) in done.chunks_exact(len).enumerate() {
                let mut row = inner.crew.row(i).map_err(broken)?;
                let told = row.working.with(|controller| controller.executed(done));
                told.map_err(|error| errors::step(&error, self.contract()))?;
            }
            Ok(())
        })
    }

    /// Frees memory and threads; all later calls are refused.
    fn close(&self) -> PyResult<()> {
        *self.lock()? = None;
        Ok(())
    }

    /// Returns the policy of the controllers.
    #[getter]
    fn policy(&self, py: Python<'_>) -> Py<Policy> {
        self.policy.clone_ref(py)
    }

    /// Returns the number of threads.
    #[getter]
    fn threads(&self) -> usize {
        self.threads
    }

    fn __len__(&self) -> usize {
        self.count
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
        format!("<lads.vector.Controllers: {} of {policy}>", self.count)
    }
}

/// Makes the exception for a batch in which a step panicked.
fn broken(_: Broken) -> PyErr {
    StepError::new_err("the batch failed before; make another")
}

/// Returns the reports of all rows as arrays.
fn report<'py>(py: Python<'py>, rows: &[StepReport]) -> PyResult<Bound<'py, PyAny>> {
    static CLASS: PyOnceLock<Py<PyType>> = PyOnceLock::new();
    let class = CLASS.import(py, "lads.vector", "Report")?;
    let timesteps = rows.iter().map(|row| i64::from(row.timestep));
    let timesteps = PyArray1::from_vec(py, timesteps.collect());
    let selected: Vec<_> = rows.iter().filter_map(|row| row.selected).collect();
    if selected.len() < rows.len() {
        return class.call1((timesteps, py.None(), py.None(), py.None()));
    }
    let indices = selected.iter().map(|it| i64::from(it.index));
    let margins = selected.iter().map(|it| it.margin);
    let fresh = selected.iter().map(|it| it.fresh);
    class.call1((
        timesteps,
        PyArray1::from_vec(py, indices.collect()),
        PyArray1::from_vec(py, margins.collect()),
        PyArray1::from_vec(py, fresh.collect()),
    ))
}
