//! Measures a plain export: a model that takes the whole history at once, on the inputs that it was exported with.

use std::path::Path;

use serde_json::Value;

use super::cut::{Data, Tensor, signature};
use super::engine::{Engine, Session, failed};
use lads_pace::BenchError;
use lads_pace::contender::{Block, Computed, Contender, Kind, Sample, Work, measure};

/// A loaded model without a KV cache.
pub struct Recompute {
    name: String,
    detail: String,
    session: Box<dyn Session>,
}

impl Recompute {
    /// Loads `model`, binds the inputs that lie beside it as JSON, and compares the logits with those there.
    pub fn new(engine: &dyn Engine, model: &Path) -> Result<Self, BenchError> {
        let name = format!("{}, no cache", engine.name());
        let beside = model.with_extension("json");
        let text = std::fs::read_to_string(&beside).map_err(|error| failed(&name, error))?;
        let values: Value = serde_json::from_str(&text).map_err(|error| failed(&name, error))?;
        let bytes = std::fs::read(model).map_err(|error| failed(&name, error))?;
        let (inputs, _) = signature(&bytes)?;
        let mut session = engine.load(&bytes)?;
        let tensors = inputs.iter().map(|input| matrix(&values[input]));
        let tensors: Option<Vec<_>> = tensors.collect();
        let tensors = tensors.ok_or_else(|| failed(&name, "its inputs are not matrices"))?;
        let named: Vec<_> = inputs.into_iter().zip(&tensors).collect();
        session.bind(&named)?;
        session.call()?;
        let wanted: Vec<f32> = serde_json::from_value(values["logits"].clone())
            .map_err(|error| failed(&name, error))?;
        let mut logits = vec![0.0; wanted.len()];
        session.read(0, &mut logits)?;
        let differences = logits.iter().zip(&wanted).map(|(a, b)| (a - b).abs());
        let largest = differences.fold(0.0_f32, f32::max);
        if largest.is_nan() || largest > 1e-3 {
            return Err(failed(&name, format!("a logit differs by {largest}")));
        }
        let detail = format!(
            "{}; the high level alone, from the whole history",
            engine.detail()
        );
        Ok(Self {
            name,
            detail,
            session,
        })
    }
}

/// Makes a tensor from rows of numbers.
fn matrix(rows: &Value) -> Option<Tensor> {
    let rows: Vec<Vec<f32>> = serde_json::from_value(rows.clone()).ok()?;
    let shape = vec![rows.len(), rows.first()?.len()];
    Some(Tensor {
        shape,
        data: Data::F32(rows.concat()),
    })
}

impl Contender for Recompute {
    fn name(&self) -> &str {
        &self.name
    }

    fn detail(&self) -> String {
        self.detail.clone()
    }

    fn replay(&mut self, _: usize) -> Result<Vec<Computed>, BenchError> {
        Err(failed(&self.name, "it computes logits only"))
    }

    fn offers(&self, work: Work) -> bool {
        matches!(work, Work::Recompute { .. })
    }

    fn block(&mut self, block: &Block, samples: &mut Vec<Sample>) -> Result<(), BenchError> {
        measure(block, samples, |_| {
            self.session
                .call()
                .map(|()| (Kind::Recompute, block.middle()))
        })
    }
}
