//! Golden steps: the policy's actions on made-up or recorded observations, computed in double
//! precision from the graph.
//!
//! What can fail: the graph's output is not a number, a recording misses a column or differs from
//! the graph.

use std::collections::HashMap;
use std::path::Path;

use base64::Engine as _;
use lads_compiler::{CompileError, Reference};
use rand_pcg::Pcg32;
use rand_pcg::rand_core::Rng as _;
use safetensors::Dtype;
use safetensors::tensor::TensorView;

use crate::plan::{Element, Plan};
use crate::problem::Problems;

/// Number of steps of a made-up episode.
pub(crate) const STEPS: usize = 64;

/// Step before which a comparison starts a second episode.
pub(crate) const RESET: usize = 40;

/// Largest number of steps of a recording that become golden ones; all of them are compared.
const KEPT: usize = 256;

/// Steps of one or more episodes: the values of each channel, the actions, and where episodes
/// begin.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Episode {
    /// Values of the channels, `[channel][step][element]`.
    pub channels: Vec<Vec<Vec<f64>>>,
    /// Actions, `[step][element]`.
    pub actions: Vec<Vec<f64>>,
    pub begins: Vec<bool>,
}

impl Episode {
    pub fn len(&self) -> usize {
        self.begins.len()
    }

    /// Returns the values of every channel in a step.
    pub fn observed(&self, step: usize) -> Vec<Vec<f64>> {
        let rows = self.channels.iter();
        rows.map(|rows| rows[step].clone()).collect()
    }

    /// Encodes the first episode, with its actions, for the bundle's metadata.
    pub fn golden(&self, plan: &Plan, tolerance: f64) -> Result<String, String> {
        let second = self.begins.iter().skip(1).position(|&begins| begins);
        let steps = second.map_or(self.len(), |at| at + 1).min(KEPT);
        let bytes = |rows: &[Vec<f64>]| -> Vec<u8> {
            let values = rows[..steps].iter().flatten();
            values
                .flat_map(|&value| (value as f32).to_le_bytes())
                .collect()
        };
        let mut all: Vec<(String, Vec<usize>, Vec<u8>)> = plan
            .channels
            .iter()
            .zip(&self.channels)
            .map(|(channel, rows)| {
                let shape = vec![steps, channel.elements.len()];
                (format!("channel.{}", channel.name), shape, bytes(rows))
            })
            .collect();
        let shape = vec![steps, plan.action.elements.len()];
        all.push(("actions".into(), shape, bytes(&self.actions)));
        let views = all.iter().map(|(name, shape, bytes)| {
            let view = TensorView::new(Dtype::F32, shape.clone(), bytes);
            view.map(|view| (name.as_str(), view))
        });
        let views = views
            .collect::<Result<Vec<_>, _>>()
            .map_err(|error| error.to_string())?;
        let metadata = HashMap::from([("tolerance".to_owned(), format!("{tolerance:e}"))]);
        let blob =
            safetensors::serialize(views, Some(metadata)).map_err(|error| error.to_string())?;
        Ok(base64::engine::general_purpose::STANDARD.encode(blob))
    }
}

/// Makes smooth observations well inside their limits, with a second episode.
pub(crate) fn made_up(plan: &Plan) -> Episode {
    let mut random = Pcg32::new(1, 1);
    let mut uniform = move || f64::from(random.next_u32()) / f64::from(u32::MAX);
    let channels = plan.channels.iter().map(|channel| {
        let waves: Vec<[f64; 5]> = (channel.elements.iter())
            .map(|Element { min, max, .. }| {
                let (phase, speed) = (std::f64::consts::TAU * uniform(), 0.02 + 0.3 * uniform());
                let half = (max - min) / 2.0;
                [min + half, half, 0.1 + 0.5 * uniform(), phase, speed]
            })
            .collect();
        let row = |step: usize| {
            let wave = |[centre, half, size, phase, speed]: &[f64; 5]| {
                let value = centre + half * size * (phase + speed * step as f64).sin();
                // As the policy will see it.
                f64::from(value as f32)
            };
            waves.iter().map(wave).collect()
        };
        (0..STEPS).map(row).collect()
    });
    Episode {
        channels: channels.collect(),
        actions: vec![],
        begins: (0..STEPS).map(|step| step == 0 || step == RESET).collect(),
    }
}

/// Computes the graph's actions on the observations of an episode.
pub(crate) fn computed(
    reference: &mut Reference,
    episode: &Episode,
) -> Result<Vec<Vec<f64>>, CompileError> {
    let mut actions = vec![];
    for step in 0..episode.len() {
        if episode.begins[step] {
            reference.reset();
        }
        actions.push(reference.step(&episode.observed(step))?);
    }
    Ok(actions)
}

/// Reads a recorded run: a column `CHANNEL.ELEMENT` for every observed element, `action.ELEMENT`
/// for every element of the executed action, and if there are several episodes a column `reset`
/// that is 1 where one begins.
pub(crate) fn recorded(path: &Path, plan: &Plan, problems: &mut Problems) -> Option<Episode> {
    let about = path.display().to_string();
    let mut reader = match lads_host::input::open(path) {
        Ok(file) => csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .from_reader(file),
        Err(error) => {
            problems.add(about, format!("cannot be read: {error}"));
            return None;
        }
    };
    let headers = match reader.headers() {
        Ok(headers) => headers.clone(),
        Err(error) => {
            problems.add(about, error);
            return None;
        }
    };
    let mut column = |name: String| {
        let found = headers.iter().position(|known| known == name);
        if found.is_none() {
            problems.add(&about, format!("has no column `{name}`"));
        }
        found
    };
    let columns: Vec<Vec<Option<usize>>> = plan
        .channels
        .iter()
        .map(|channel| {
            let names = channel.elements.iter();
            let names = names.map(|element| format!("{}.{}", channel.name, element.name));
            names.map(&mut column).collect()
        })
        .collect();
    let names = plan.action.elements.iter();
    let actions: Vec<Option<usize>> = names
        .map(|element| column(format!("action.{}", element.name)))
        .collect();
    let reset = headers.iter().position(|known| known == "reset");
    let mut episode = Episode {
        channels: vec![vec![]; columns.len()],
        ..Episode::default()
    };
    for (row, record) in reader.records().enumerate() {
        let record = match record {
            Ok(record) => record,
            Err(error) => {
                problems.add(&about, error);
                return None;
            }
        };
        let mut value = |column: &Option<usize>| {
            let text = column.and_then(|column| record.get(column)).unwrap_or("0");
            let number = text.parse::<f32>().ok().filter(|number| number.is_finite());
            if number.is_none() {
                problems.add(
                    &about,
                    format!("row {row}: `{text}` is not a finite number"),
                );
            }
            f64::from(number.unwrap_or(0.0))
        };
        for (rows, columns) in episode.channels.iter_mut().zip(&columns) {
            rows.push(columns.iter().map(&mut value).collect());
        }
        episode
            .actions
            .push(actions.iter().map(&mut value).collect());
        let begins = row == 0 || reset.is_some_and(|column| value(&Some(column)) != 0.0);
        episode.begins.push(begins);
    }
    if episode.len() == 0 {
        problems.add(&about, "has no rows");
    }
    Some(episode)
}
