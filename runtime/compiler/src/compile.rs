//! The whole way from a bundle to an image.

use std::collections::HashMap;
use std::fmt;

use lads_core::Policy;
use lads_image::op::{CacheFormat, Port, WeightFormat, WeightSpan};

use crate::bundle::Bundle;
use crate::entries::{
    self, ACT, ENCODE, INSTRUCT, LOOKUP_INSTRUCTION, LOOKUP_PLAN, START, STEP, Signature,
};
use crate::error::CompileError;
use crate::fuse::fuse;
use crate::image::{self, Image, Parts};
use crate::import::Model;
use crate::lower::{Cache, Weights, lower};
use crate::memory::Memory;
use crate::plan::{Placed, plan};
use crate::report::{CompileReport, ProgramReport};
use crate::tensor::Tensor;
use crate::verify::verify;

/// One program of the image: what it is compiled from and which outputs it keeps.
pub(crate) struct Recipe {
    pub name: &'static str,
    pub entry: &'static str,
    pub outputs: &'static [&'static str],
    pub ports: &'static [(&'static str, Port)],
}

/// In the order of `lads_core::image::ProgramKind`.
pub(crate) const RECIPES: [Recipe; 7] = [
    Recipe {
        name: "instruct",
        entry: INSTRUCT,
        outputs: &[],
        ports: &[("words", Port::Words)],
    },
    Recipe {
        name: "start",
        entry: START,
        outputs: &["logits"],
        ports: &[
            ("observation", Port::Observation),
            ("timestep", Port::Timestep),
            ("logits", Port::Logits),
        ],
    },
    Recipe {
        name: "step_decide",
        entry: STEP,
        outputs: &["logits"],
        ports: STEP_PORTS,
    },
    Recipe {
        name: "step_record",
        entry: STEP,
        outputs: &[],
        ports: STEP_PORTS,
    },
    Recipe {
        name: "lookup",
        entry: LOOKUP_PLAN,
        outputs: &["plan"],
        ports: &[("index", Port::PlanIndex), ("plan", Port::Plan)],
    },
    Recipe {
        name: "act",
        entry: ACT,
        outputs: &["action"],
        ports: &[
            ("observation", Port::Observation),
            ("plan", Port::Plan),
            ("action", Port::Action),
        ],
    },
    Recipe {
        name: "encode",
        entry: ENCODE,
        outputs: &["index", "latent"],
        ports: &[
            ("observations", Port::Observations),
            ("actions", Port::Actions),
            ("index", Port::PlanIndex),
            ("latent", Port::Latent),
        ],
    },
];

const STEP_PORTS: &[(&str, Port)] = &[
    ("action", Port::Action),
    ("observation", Port::Observation),
    ("timestep", Port::Timestep),
    ("logits", Port::Logits),
];

/// One program that was made.
struct Made {
    placed: Placed,
    tokens: usize,
    report: ProgramReport,
}

/// What a compilation may choose.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Options {
    /// How the weights of dense layers are stored.
    pub weights: WeightFormat,
    /// How those of the low level are, if otherwise: they alone are in the action, all others only help to choose the plan.
    pub low_level: Option<WeightFormat>,
    /// How the KV cache is stored.
    pub cache: CacheFormat,
    /// How far an action may be from the recorded one, instead of what the bundle says; the image's self-test keeps to it too.
    pub tolerance: Option<f32>,
    /// Whether an image is made even if the gate refuses it; its self-test then fails.
    pub force: bool,
}

impl Options {
    /// Whether nothing is stored with fewer bits than it was computed with.
    pub fn is_exact(&self) -> bool {
        let weights = [self.weights, self.low_level()];
        weights == [WeightFormat::F32; 2] && self.cache == CacheFormat::F32
    }

    fn low_level(&self) -> WeightFormat {
        self.low_level.unwrap_or(self.weights)
    }
}

/// For example `f16 weights (low level f32) and an f16 cache`.
impl fmt::Display for Options {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} weights", self.weights.name())?;
        if self.low_level() != self.weights {
            write!(f, " (low level {})", self.low_level().name())?;
        }
        match self.cache {
            CacheFormat::F32 => Ok(()),
            CacheFormat::F16 => f.write_str(" and an f16 cache"),
        }
    }
}

/// Compiles a bundle with 32-bit weights and cache.
pub fn compile(bundle: &Bundle) -> Result<Image, CompileError> {
    compile_with(bundle, Options::default())
}

/// Compiles a bundle. Weights or a cache of fewer bits have to pass a gate, unless forced: the image that was made replays the bundle's golden
/// episode with the same plans, and with actions inside the episode's tolerance.
pub fn compile_with(bundle: &Bundle, options: Options) -> Result<Image, CompileError> {
    let contract = bundle.contract();
    let signatures = entries::signatures(contract);
    let model = Model::new(&bundle.model, bundle.graph())?;
    let cache = Cache::new(contract, options.cache);
    let cache_len = cache.len().ok_or_else(|| CompileError::TooLarge {
        what: "the KV cache".into(),
    })?;
    // Before the compiler itself takes memory that grows with the context.
    Memory::bytes_of(cache_len as usize)?;
    let mut weights = Weights::default();
    let mut made: Vec<Made> = vec![];
    // Whole matrices come before the parts of them that other programs need, and what runs in every control step comes first.
    let (before, rest) = RECIPES.split_at(1);
    for recipe in rest.iter().chain(before) {
        let signature = signature(&signatures, recipe.entry)?;
        let entry = model.import(signature, &HashMap::new())?;
        let fused = fuse(entry, signature, recipe.outputs)?;
        weights.format = if recipe.entry == ACT {
            options.low_level()
        } else {
            options.weights
        };
        let lowered = lower(recipe.entry, &fused, recipe.ports, cache, &mut weights)?;
        let placed = plan(&lowered);
        verify(&lowered, &placed).map_err(|fault| CompileError::Plan {
            program: recipe.name,
            fault,
        })?;
        let report = ProgramReport {
            name: recipe.name,
            entry: recipe.entry,
            ops: placed.ops.len(),
            arena_len: placed.arena_len as usize,
            arena_lower_bound: placed.lower_bound as usize,
        };
        made.push(Made {
            placed,
            tokens: lowered.tokens,
            report,
        });
    }
    made.rotate_right(before.len());
    let words = instruction_words(
        bundle,
        &model,
        signature(&signatures, LOOKUP_INSTRUCTION)?,
        &mut weights,
    )?;
    let report = CompileReport {
        programs: made.iter().map(|made| made.report.clone()).collect(),
        weight_bytes: weights.data.len() * 4,
        cache_len: cache_len as usize,
    };
    let programs: Vec<(&Placed, usize)> = made
        .iter()
        .map(|made| (&made.placed, made.tokens))
        .collect();
    let parts = Parts {
        programs: &programs,
        words: &words,
        weights: &weights.data,
        cache_len,
        tolerance: options.tolerance.unwrap_or(bundle.golden().tolerance),
    };
    let image = image::write(bundle, &parts, report)?;
    let policy = Policy::new_checked(image.as_bytes()).map_err(CompileError::Image)?;
    if !options.is_exact() && !options.force {
        let mut memory = Memory::of(&policy)?;
        memory
            .controller(&policy)?
            .self_test()
            .map_err(|error| CompileError::Gate {
                stored: options.to_string().into(),
                error,
                tolerance: parts.tolerance,
            })?;
    }
    Ok(image)
}

fn signature<'s>(signatures: &'s [Signature], entry: &str) -> Result<&'s Signature, CompileError> {
    let missing = || CompileError::Entry {
        entry: entry.into(),
        problem: "it belongs to no policy of this kind".into(),
    };
    signatures
        .iter()
        .find(|signature| signature.entry == entry)
        .ok_or_else(missing)
}

/// The words of every known instruction: the entry is evaluated for each id.
fn instruction_words(
    bundle: &Bundle,
    model: &Model,
    signature: &Signature,
    weights: &mut Weights,
) -> Result<Vec<(u32, WeightSpan)>, CompileError> {
    let contract = bundle.contract();
    let refused = |problem: String| CompileError::Entry {
        entry: LOOKUP_INSTRUCTION.into(),
        problem: problem.into(),
    };
    let mut all = vec![];
    for (id, known) in contract.instructions.iter().enumerate() {
        let entry = model.import(
            signature,
            &HashMap::from([("id", Tensor::i64(&[1], vec![id as i64]))]),
        )?;
        let constant = |name: &str| {
            let found = entry.outputs.iter().find(|(output, _)| output == name);
            found.and_then(|&(_, id)| entry.graph.constant(id))
        };
        let length = constant("length")
            .and_then(|tensor| tensor.as_i64().and_then(|data| data.first().copied()));
        let words = constant("words").and_then(|tensor| tensor.as_f32());
        let (Some(length), Some(words)) = (length, words) else {
            return Err(refused(format!(
                "it is not a table: instruction {} does not evaluate to constants",
                known.id
            )));
        };
        let length = usize::try_from(length)
            .ok()
            .filter(|length| (1..=contract.context.words).contains(length));
        let length = length.ok_or_else(|| {
            refused(format!(
                "instruction {} has no length from 1 to the contract's `context.words` {}",
                known.id, contract.context.words
            ))
        })?;
        if words.iter().any(|x| !x.is_finite()) {
            return Err(refused(format!(
                "the words of instruction {} are not finite",
                known.id
            )));
        }
        let span = weights
            .store(&words[..length * contract.language.dim])
            .map_err(refused)?;
        all.push((length as u32, span));
    }
    Ok(all)
}
