//! Prepares all contenders: opens them and compares their results, before anything is timed.

use lads_compiler::{CacheFormat, Options, Storage, WeightFormat};
use lads_core::{Controller, Policy};
use lads_host::Memory;

use crate::clock::now;
use crate::contender::{Contender, Episode, compare};
use crate::error::BenchError;
use crate::lads::Lads;

/// Number of control steps that are compared.
const COMPARED: usize = 60;

/// Largest difference of an action from the recorded one that may be rounding.
const BROKEN: f32 = 0.1;

/// Name of the formats that a bundle was tuned to, which [`options`] gives for no format.
pub const AUTO: &str = "auto";

/// Returns the options that compile a policy for a measurement: as it was tuned, or with one format
/// for all weights. With fewer bits for the weights, the cache has half of them too, and the
/// tolerance, which is otherwise the machine's, only has to distinguish a sound policy from a broken
/// one.
pub fn options(weights: Option<WeightFormat>) -> Options {
    let Some(weights) = weights else {
        return Options::default();
    };
    if weights == WeightFormat::F32 {
        return Options::exact();
    }
    Options {
        storage: Some(Storage::of_weights(weights).with_cache(CacheFormat::F16)),
        tolerance: Some(BROKEN),
        ..Options::default()
    }
}

/// A program image to measure.
#[derive(Debug, Clone, Copy)]
pub struct Candidate<'i> {
    /// Format of the weights, such as `f32`, or [`AUTO`].
    pub weights: &'i str,
    /// The compiled program image, aligned to four bytes.
    pub image: &'i [u8],
    /// Largest difference of an action from the recorded one that is accepted.
    pub tolerance: f32,
}

impl<'i> Candidate<'i> {
    /// Makes the candidate of an image that opens as `policy`, which accepts what its golden episode does.
    pub fn new(weights: &'i str, image: &'i [u8], policy: &Policy<'_>) -> Self {
        Self {
            weights,
            image,
            tolerance: policy.golden().map_or(0.0, |golden| golden.tolerance()),
        }
    }
}

/// Other programs that run the same policy.
pub trait Others {
    /// Opens the other contenders; those that were asked for and cannot be run are reported to
    /// `absent`, with the reason.
    fn open<'e>(
        &self,
        episode: &'e Episode,
        absent: &mut Vec<String>,
    ) -> Vec<Box<dyn Contender + 'e>>;
}

/// An empty set of other contenders.
#[derive(Debug, Clone, Copy)]
pub struct Nobody;

impl Others for Nobody {
    fn open<'e>(&self, _: &'e Episode, _: &mut Vec<String>) -> Vec<Box<dyn Contender + 'e>> {
        vec![]
    }
}

/// A contender that is ready to be measured.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Entrant {
    /// Name of the contender.
    pub name: String,
    /// Version and settings of the contender.
    pub detail: String,
    /// Largest difference of an action from the recorded episode.
    pub largest_error: f32,
    /// Time of the first instruction and control step of this process, in nanoseconds.
    pub first_ns: u64,
    /// Median time of a repeated instruction and control step, in nanoseconds.
    pub again_ns: u64,
}

/// Episode and contenders of a measurement.
#[derive(Debug)]
pub struct Field<'f> {
    /// Episode that was measured.
    pub episode: &'f Episode,
    /// Number of words of the episode's instruction; 0 without one.
    pub words: usize,
    /// Contenders that take part.
    pub entrants: Vec<Entrant>,
    /// Contenders that were asked for and could not be run, with the reason.
    pub absent: Vec<String>,
}

/// Opens all contenders, compares them, and lends them to `body`. Guests come last and are not
/// compared, because they run no policy.
pub fn with_contenders<R>(
    candidates: &[Candidate<'_>],
    others: &dyn Others,
    mut guests: Vec<Box<dyn Contender>>,
    body: impl FnOnce(&Field<'_>, &mut [&mut dyn Contender]) -> Result<R, BenchError>,
) -> Result<R, BenchError> {
    let refused = |error: &dyn std::fmt::Display| {
        BenchError::new("the policy", error, "compile it again from its bundle")
    };
    let policies = candidates
        .iter()
        .map(|candidate| Policy::new_checked(candidate.image));
    let policies: Vec<_> = policies
        .collect::<Result<_, _>>()
        .map_err(|error| refused(&error))?;
    let Some(first) = policies.first() else {
        return Err(BenchError::new(
            "the benchmark",
            "there is no policy",
            "name one",
        ));
    };
    let episode = Episode::of(first)?;
    let known = episode
        .instruction
        .and_then(|number| first.contract().instruction(number as usize));
    let words = known.map_or(0, |known| {
        known.words.len() / first.contract().word_dim().max(1)
    });
    let memories = policies.iter().map(Memory::of).collect::<Result<_, _>>();
    let mut memories: Vec<Memory> = memories.map_err(|error| refused(&error))?;
    let controllers = memories
        .iter_mut()
        .zip(&policies)
        .map(|(memory, policy)| memory.controller(policy));
    let mut controllers: Vec<Controller<'_, '_>> = controllers
        .collect::<Result<_, _>>()
        .map_err(|error| refused(&error))?;
    let mut ours: Vec<_> = controllers
        .iter_mut()
        .zip(candidates)
        .map(|(controller, candidate)| Lads::new(candidate.weights, controller, &episode))
        .collect();
    let mut absent = vec![];
    let mut others = others.open(&episode, &mut absent);

    let tolerance = first.golden().map_or(0.0, |golden| golden.tolerance());
    let tolerances = candidates.iter().map(|candidate| candidate.tolerance);
    let tolerances = tolerances.chain(std::iter::repeat(tolerance));
    let ours = ours
        .iter_mut()
        .map(|contender| contender as &mut dyn Contender);
    let others = others
        .iter_mut()
        .map(|contender| contender.as_mut() as &mut dyn Contender);
    let mut contenders: Vec<&mut dyn Contender> = ours.chain(others).collect();
    let mut entrants = vec![];
    for (contender, tolerance) in contenders.iter_mut().zip(tolerances) {
        entrants.push(admit(*contender, &episode, tolerance)?);
    }
    let field = Field {
        episode: &episode,
        words,
        entrants,
        absent,
    };
    contenders.extend(
        guests
            .iter_mut()
            .map(|guest| guest.as_mut() as &mut dyn Contender),
    );
    body(&field, &mut contenders)
}

/// Times the first calls, then compares a stretch of the episode.
fn admit(
    contender: &mut dyn Contender,
    episode: &Episode,
    tolerance: f32,
) -> Result<Entrant, BenchError> {
    let mut timed = || -> Result<u64, BenchError> {
        let start = now();
        contender.replay(1)?;
        Ok(now() - start)
    };
    let first_ns = timed()?;
    let mut again = (0..15).map(|_| timed()).collect::<Result<Vec<_>, _>>()?;
    again.sort_unstable();
    let compared = COMPARED.min(episode.recorded.len());
    let computed = contender.replay(compared)?;
    let wanted = episode.recorded.get(..compared).unwrap_or_default();
    let largest_error = compare(contender.name(), &computed, wanted, tolerance)?;
    Ok(Entrant {
        name: contender.name().to_owned(),
        detail: contender.detail(),
        largest_error,
        first_ns,
        again_ns: again.get(again.len() / 2).copied().unwrap_or(0),
    })
}
