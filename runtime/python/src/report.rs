//! Report of a control step, besides its action.

use pyo3::prelude::*;

/// Result of a control step, besides its action.
#[pyclass(frozen, eq, module = "lads")]
#[derive(PartialEq)]
pub struct StepReport {
    /// Control steps since the context began: 0 in the first step after an instruction, a reset or a restart of the context.
    #[pyo3(get)]
    pub timestep: u32,
    selected: Option<lads_core::Selected>,
}

/// The index in force, such as that of a latent plan, and how it was selected.
#[pyclass(frozen, eq, module = "lads")]
#[derive(PartialEq)]
pub struct Selected {
    /// Index selected, from 0.
    #[pyo3(get)]
    index: u32,
    /// The largest score of the last selection minus the second largest; infinite with a single one.
    #[pyo3(get)]
    margin: f32,
    /// True if this step selected the index.
    #[pyo3(get)]
    fresh: bool,
}

impl From<lads_core::StepReport> for StepReport {
    fn from(report: lads_core::StepReport) -> Self {
        Self {
            timestep: report.timestep,
            selected: report.selected,
        }
    }
}

#[pymethods]
impl StepReport {
    /// Returns the index in force; None for a policy that selects none.
    #[getter]
    fn selected(&self) -> Option<Selected> {
        self.selected.map(|selected| Selected {
            index: selected.index,
            margin: selected.margin,
            fresh: selected.fresh,
        })
    }

    fn __repr__(&self) -> String {
        let selected = self
            .selected()
            .map_or_else(|| "None".to_owned(), |selected| selected.__repr__());
        format!(
            "StepReport(timestep={}, selected={selected})",
            self.timestep
        )
    }
}

#[pymethods]
impl Selected {
    fn __repr__(&self) -> String {
        let fresh = if self.fresh { "True" } else { "False" };
        format!(
            "Selected(index={}, margin={}, fresh={fresh})",
            self.index, self.margin
        )
    }
}
