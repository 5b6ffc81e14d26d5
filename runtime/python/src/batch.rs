//! Steps a batch of controllers of one policy over threads: many observations in, as many actions
//! out.
//!
//! All observations are checked before the first controller steps, so that a refusal leaves all
//! controllers unchanged. The threads are the batch's own, started once.

use std::num::NonZero;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};
use std::thread;

use lads_core::{ChannelId, Data, StepError as CoreStepError};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::{PyList, PyTuple};
use rayon::prelude::*;

use crate::arrays::{self, Staged, Target};
use crate::cell::{Checked, Working};
use crate::controller::{Settings, Told};
use crate::errors::{self, BusyError, ClosedError, InputError, StepError, WorkspaceError};
use crate::policy::Policy;
use crate::process::Process;

/// One of the controllers, with the results of its last step.
struct Row {
    working: Working,
    report: lads_core::StepReport,
    failed: Option<CoreStepError>,
}

struct Inner {
    /// Threads of the batch; not dropped in a forked child, which has none of its threads.
    pool: rayon::ThreadPool,
    rows: Vec<Row>,
    staged: Vec<Staged>,
    given: Vec<bool>,
    actions: Vec<f32>,
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
        if let Some(Inner { pool, .. }) = inner.take() {
            std::mem::forget(pool);
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
            Err(TryLockError::Poisoned(_)) => {
                Err(StepError::new_err("the batch failed before; make another"))
            }
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

    /// Returns the selected rows: all, or those of a list.
    fn chosen(&self, rows: Option<Vec<usize>>) -> PyResult<Vec<usize>> {
        let rows = rows.unwrap_or_else(|| (0..self.count).collect());
        match rows.iter().find(|&&row| row >= self.count) {
            None => Ok(rows),
            Some(row) => Err(InputError::new_err(format!(
                "row {row}: the batch has {}; give rows from 0 on",
                self.count
            ))),
        }
    }
}

#[pymethods]
impl Controllers {
    /// Makes `count` controllers of a policy, with `threads` threads (all of the machine's by
    /// default, never more than controllers). `instruction` is one for all, or a list with one for
    /// each. The seed of row i is `sample + i` and `noise + i`.
    #[new]
    #[pyo3(signature = (policy, count, instruction=None, *, threads=None, sample=None, noise=None, portable=false))]
    fn new(
        policy: &Bound<'_, Policy>,
        count: usize,
        instruction: Option<Bound<'_, PyAny>>,
        threads: Option<usize>,
        sample: Option<u64>,
        noise: Option<u64>,
        portable: bool,
    ) -> PyResult<Self> {
        if count == 0 || threads == Some(0) {
            return Err(InputError::new_err(
                "a batch of no controllers or no threads; give one or more",
            ));
        }
        let checked = Arc::clone(policy.get().checked());
        let view = checked.view();
        let contract = view.contract();
        let rows = (0..count as u64).map(|row| {
            let seed = |seed: Option<u64>| seed.map(|seed| seed.wrapping_add(row));
            let settings = Settings {
                sample: seed(sample),
                noise: seed(noise),
                portable,
            };
            Ok(Row {
                working: settings.working(&checked)?,
                report: lads_core::StepReport {
                    timestep: 0,
                    selected: None,
                },
                failed: None,
            })
        });
        let rows = rows.collect::<PyResult<Vec<_>>>()?;
        let staged = contract.observations();
        let staged: Vec<_> = staged
            .map(|channel| Staged::batch(&channel, count))
            .collect();
        let all = || thread::available_parallelism().map_or(1, NonZero::get);
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads.unwrap_or_else(all).min(count))
            .thread_name(|index| format!("lads-{index}"))
            .build()
            .map_err(|error| {
                WorkspaceError::new_err(format!(
                    "the threads cannot be started ({error}); ask for fewer"
                ))
            })?;
        let threads = pool.current_num_threads();
        let inner = Inner {
            pool,
            given: vec![false; staged.len()],
            staged,
            actions: vec![0.0; count * contract.action_len()],
            rows,
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
            let needed = inner.staged.len();
            arrays::read(observations, &mut inner.staged, needed, &mut inner.given)?;
            let target = Target::of(out, "actions", &[count, len])?;
            let Inner {
                pool,
                rows,
                staged,
                actions,
                ..
            } = &mut *inner;
            let contract = self.contract();
            let inputs = |i: usize| -> Vec<(ChannelId, Data<'_>)> {
                staged.iter().map(|row| row.row(i, count)).collect()
            };
            let refused = py.detach(|| {
                let refused: Vec<_> = (0..count)
                    .filter_map(|i| Some((i, contract.check_observations(&inputs(i)).err()?)))
                    .collect();
                if refused.is_empty() {
                    let step = |(i, (row, action)): (usize, (&mut Row, &mut [f32]))| {
                        let stepped = row
                            .working
                            .with(|controller| controller.step_with(&inputs(i), action));
                        row.failed = stepped.as_ref().err().copied();
                        if let Ok(report) = stepped {
                            row.report = report;
                        }
                    };
                    let all = rows.par_iter_mut().zip(actions.par_chunks_mut(len));
                    pool.install(|| all.enumerate().for_each(step));
                }
                refused
            });
            if !refused.is_empty() {
                let rows = refused
                    .iter()
                    .map(|(i, error)| format!("row {i}: {}", lads_host::refused(error, contract)));
                return Err(errors::input(rows.collect::<Vec<_>>().join(", ")));
            }
            let failed: Vec<_> = rows
                .iter()
                .enumerate()
                .filter_map(|(i, row)| Some((i, row.failed?)))
                .collect();
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
            Ok((target.put(py, actions)?, report(py, rows)?))
        })
    }

    /// Sets an instruction: one for all rows, or a list of one for each of `rows` (all by default).
    /// If one is refused, the rows before it follow theirs.
    #[pyo3(signature = (instruction, rows=None))]
    fn instruct(
        &self,
        py: Python<'_>,
        instruction: &Bound<'_, PyAny>,
        rows: Option<Vec<usize>>,
    ) -> PyResult<()> {
        let chosen = self.chosen(rows)?;
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
            let done = py.detach(|| {
                chosen.iter().enumerate().try_for_each(|(place, &row)| {
                    let told = &told[place.min(told.len() - 1)];
                    inner.rows[row]
                        .working
                        .with(|controller| controller.set_instruction(told.as_instruction()))
                })
            });
            done.map_err(|error| errors::instruction(&error))
        })
    }

    /// Starts new episodes in `rows`, all by default.
    #[pyo3(signature = (rows=None))]
    fn reset(&self, rows: Option<Vec<usize>>) -> PyResult<()> {
        let chosen = self.chosen(rows)?;
        self.work(|inner| {
            for row in chosen {
                inner.rows[row]
                    .working
                    .with(|controller| controller.reset());
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
            for (row, done) in inner.rows.iter_mut().zip(done.chunks_exact(len)) {
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

/// Returns the reports of all rows as arrays.
fn report<'py>(py: Python<'py>, rows: &[Row]) -> PyResult<Bound<'py, PyAny>> {
    let timesteps: Vec<_> = rows
        .iter()
        .map(|row| i64::from(row.report.timestep))
        .collect();
    let selected: Vec<_> = rows.iter().filter_map(|row| row.report.selected).collect();
    let arrays = (selected.len() == rows.len()).then(|| {
        let indices: Vec<_> = selected.iter().map(|it| i64::from(it.index)).collect();
        let margins: Vec<_> = selected.iter().map(|it| it.margin).collect();
        let fresh: Vec<_> = selected.iter().map(|it| it.fresh).collect();
        (
            PyArray1::from_vec(py, indices),
            PyArray1::from_vec(py, margins),
            PyArray1::from_vec(py, fresh),
        )
    });
    let timesteps = PyArray1::from_vec(py, timesteps);
    let class = py.import("lads.vector")?.getattr("Report")?;
    match arrays {
        Some((indices, margins, fresh)) => class.call1((timesteps, indices, margins, fresh)),
        None => class.call1((timesteps, py.None(), py.None(), py.None())),
    }
}
