//! Finds the smallest image that keeps every plan: formats for weights and caches, chosen by the policy's answers with them.
//!
//! The policy answers the recorded questions of a reference (open loop, as in [`verify::policy`](crate::verify::policy)) once with 32 bits
//! and once with each candidate's; [`lads_proof::rounding`] compares the two, as a certificate does, [`mod@search`] tries candidates from the smallest up. The golden episode alone
//! is not evidence: a policy may replay it with the same bits and decide otherwise elsewhere. What can fail: a bundle that does not compile
//! even with 32 bits, memory; it can be told to stop.

mod groups;
pub mod search;

use std::sync::atomic::AtomicBool;

use lads_compiler::{Bundle, CompileError, Image, Options, Storage};
use lads_core::{Decision, Isa, Policy};
use lads_proof::answers::{ACTION_TOLERANCE, LOGIT_TOLERANCE, Replay};
use lads_proof::reference::Reference;
use lads_proof::rounding::{Allowed, Rounding};

use crate::evaluate::{Assignment, EvaluationError};
use crate::verify::policy::{self, Questions};
use crate::verify::shown::Shown;
use groups::Groups;
use search::{Found, Parts, search};

/// Why a bundle cannot be tuned.
#[derive(Debug, thiserror::Error)]
pub enum TuneError {
    /// The bundle does not compile with 32 bits.
    #[error(transparent)]
    Compile(#[from] CompileError),
    /// The questions cannot be asked, or an interrupt came.
    #[error(transparent)]
    Asking(#[from] EvaluationError),
    /// The policy with 32 bits refuses a question: the reference was made for something else.
    #[error(
        "with 32 bits the policy refuses a step of the reference: {0}; make the reference again"
    )]
    Refused(String),
    /// The questions are so close that the policy is not clear about its own answers.
    #[error(
        "the policy with 32 bits does not pass itself: {0}; make a reference with other episodes"
    )]
    Unclear(String),
}

/// Inputs of a search for formats.
#[derive(Debug, Clone, Copy)]
pub struct Tuning<'t> {
    /// The bundle to tune.
    pub bundle: &'t Bundle,
    /// The reference whose traced episodes are the questions.
    pub reference: &'t Reference,
    /// Instructions whose episodes are asked about.
    pub assignments: &'t [Assignment],
    /// What the cameras show in its traced episodes; `None` for a policy without.
    pub shown: Option<&'t Shown>,
    /// Instruction set that the kernels run on; the answers have the same bits on all.
    pub isa: Isa,
}

/// Result of a search for formats.
#[derive(Debug)]
pub struct Tuned {
    /// Smallest formats that keep every plan, with the measured differences.
    pub found: Found,
    /// Description of the image with 32 bits, and with the chosen formats.
    pub images: [Image; 2],
}

impl Tuning<'_> {
    /// Searches for the smallest formats. `tried` is called with each candidate before it is asked.
    pub fn run(
        &self,
        stop: &AtomicBool,
        tried: &mut dyn FnMut(&Storage),
    ) -> Result<Tuned, TuneError> {
        let exact = self.compile(&Storage::default())?;
        let wanted = self.ask(&exact, stop)?;
        if let Some(why) = wanted.iter().find_map(|replay| replay.refused.clone()) {
            return Err(TuneError::Refused(why));
        }
        let allowed = self.allowed(&exact);
        let own = Rounding::judge(&wanted, &wanted, allowed);
        if let Some(loss) = &own.loss {
            return Err(TuneError::Unclear(loss.to_string()));
        }
        let parts = self.parts(&exact, own.segments > 0)?;
        let found = search(&parts, own, &mut |storage| {
            tried(storage);
            match self.compile(storage) {
                Ok(image) => Ok(Rounding::judge(&wanted, &self.ask(&image, stop)?, allowed)),
                Err(CompileError::Gate { error, .. }) => Ok(Rounding::refused(format!(
                    "the golden episode does not replay: {error}"
                ))),
                Err(error) => Ok(Rounding::refused(error.to_string())),
            }
        });
        let found: Found = found.map_err(TuneError::Asking)?;
        let image = self.compile(&found.storage)?;
        Ok(Tuned {
            found,
            images: [exact, image],
        })
    }

    /// Returns the allowed differences: half of a certificate's, whose episodes are others, and which compares with the reference, from which 32 bits
    /// are some way off themselves. Logits count by their values only where a draw depends on them.
    fn allowed(&self, exact: &Image) -> Allowed {
        let draws = view(exact).contract().decision() != Decision::Argmax;
        Allowed {
            action: f64::from(self.bundle.golden().tolerance).min(ACTION_TOLERANCE) / 2.0,
            logit: draws.then_some(LOGIT_TOLERANCE / 2.0),
        }
    }

    /// Lists the parts whose storage may change. Entries that read the same weights, as those do that read one token each of one network, are one
    /// part: stored in two formats, the weights would be there twice. What nobody asked keeps its bits.
    fn parts(&self, exact: &Image, encoder_was_asked: bool) -> Result<Parts, CompileError> {
        let smallest = Options {
            storage: Some(Storage::of_weights(search::WEIGHTS[0])),
            force: true,
            ..Options::default()
        };
        let smallest = lads_compiler::compile_with(self.bundle, &smallest)?;
        let unasked = if encoder_was_asked {
            vec![]
        } else {
            self.bundle.encoding_entries()
        };
        let mut groups = Groups::default();
        let programs = exact.report().programs.iter();
        let programs = programs.zip(&smallest.report().programs);
        for (program, small) in programs.filter(|(it, _)| !unasked.contains(&it.entry)) {
            for (layer, small) in program.layers.iter().zip(&small.layers) {
                groups.add(&program.entry, layer, layer.format != small.format);
            }
        }
        Ok(Parts {
            groups: groups.sorted(),
            has_cache: exact.report().cache_len > 0,
        })
    }

    fn compile(&self, storage: &Storage) -> Result<Image, CompileError> {
        let options = Options {
            storage: Some(storage.clone()),
            ..Options::default()
        };
        lads_compiler::compile_with(self.bundle, &options)
    }

    fn ask(&self, image: &Image, stop: &AtomicBool) -> Result<Vec<Replay>, EvaluationError> {
        let questions = Questions {
            reference: self.reference,
            assignments: self.assignments,
            episodes: self.reference.traced_episodes,
            shown: self.shown,
        };
        // The likeliest index, whatever the contract's rule: margins say nothing of a draw.
        let how = (self.isa, Decision::Argmax);
        policy::ask(&view(image), how, questions, stop, &|| {})
    }
}

fn view(image: &Image) -> Policy<'_> {
    Policy::new_checked(image.as_bytes())
        .unwrap_or_else(|error| unreachable!("the compiler checked it: {error}"))
}
