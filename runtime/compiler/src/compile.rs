//! Compiles a bundle to an image, through all stages.

use std::collections::{HashMap, HashSet};

use lads_core::{Controller, Policy, PolicyError, ScheduleError, SelfTestError, Workspace};
use lads_image::op::CacheFormat;

use crate::bundle::Bundle;
use crate::entries::{self, LOOKUP_INSTRUCTION, Signature};
use crate::error::{BundleError, CompileError};
use crate::family::{Blueprint, Entry, Keep, Origin};
use crate::fuse::{Fused, fuse};
use crate::graph::Dim;
use crate::image::{self, Image, Parts};
use crate::import::Model;
use crate::lower::{Cache, Weights, lower};
use crate::plan::{Placed, plan};
use crate::reach::Reach;
use crate::report::{CompileReport, ProgramReport};
use crate::storage::Storage;
use crate::tensor::Tensor;
use crate::verify::verify;

/// A compiled program with its entry.
pub(crate) struct Made {
    /// Index into the blueprint's entries.
    pub entry: usize,
    pub placed: Placed,
    pub tokens: usize,
}

/// Options of a compilation.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Options {
    /// Storage of weights and caches; if `None`, the formats that the bundle was
    /// [tuned](Bundle::tuned) for, or 32 bits if it was not tuned.
    pub storage: Option<Storage>,
    /// Largest difference of an action from the recorded one, in place of the bundle's tolerance;
    /// the image's self-test uses it too.
    pub tolerance: Option<f32>,
    /// True to make an image even if the gate refuses it; its self-test then fails.
    pub force: bool,
}

impl Options {
    /// Options for 32 bits everywhere, whatever the bundle was tuned for.
    pub fn exact() -> Self {
        Self {
            storage: Some(Storage::default()),
            ..Self::default()
        }
    }

    /// Returns the storage of this bundle's image. Fails if the bundle's record is needed and
    /// invalid.
    pub fn storage(&self, bundle: &Bundle) -> Result<Storage, BundleError> {
        if let Some(storage) = &self.storage {
            return Ok(storage.clone());
        }
        let tuned = bundle.tuned()?.map(|tuned| tuned.storage.clone());
        Ok(tuned.unwrap_or_default())
    }
}

/// Compiles a bundle with the number formats that it was [tuned](Bundle::tuned) for, or with 32
/// bits.
pub fn compile(bundle: &Bundle) -> Result<Image, CompileError> {
    compile_with(bundle, &Options::default())
}

/// Compiles a bundle with the given options. Weights or a cache of fewer bits have to pass a gate,
/// unless forced: the compiled image replays the bundle's golden episode with the same indices, and
/// with actions inside the episode's tolerance.
pub fn compile_with(bundle: &Bundle, options: &Options) -> Result<Image, CompileError> {
    let contract = bundle.contract();
    let storage = options.storage(bundle).map_err(CompileError::Bundle)?;
    let blueprint = contract.family.kind().blueprint(contract);
    let signatures =
        entries::signatures(bundle.graph(), contract, &blueprint).map_err(CompileError::Bundle)?;
    let model = Model::new(&bundle.model, bundle.graph())?;
    let caches = caches(bundle, &blueprint, &signatures, storage.cache)?;
    let reach = Reach::new(contract, &blueprint);
    let mut weights = Weights::new(&storage);
    let (mut made, mut programs) = (vec![], vec![]);
    // In the order of the blueprint: whole matrices come before the parts of them that other programs need, and what runs in every
    // control step comes first.
    let idle = blueprint.idle(contract);
    for (index, entry) in blueprint.entries.iter().enumerate() {
        if idle.contains(&entry.name) {
            continue;
        }
        let Some(fused) = fused(&model, &signatures, &blueprint, entry)? else {
            continue;
        };
        weights.entry = entry.graph().unwrap_or_default();
        let cache = entry.cache.as_ref().and_then(|name| caches.get(name));
        let lowered = lower(
            &entry.name,
            &fused,
            *cache.unwrap_or(&Cache::NONE),
            &mut weights,
        )?;
        if lowered.ops.is_empty() {
            return Err(CompileError::Entry {
                entry: entry.name.as_str().into(),
                problem: "it computes nothing: its outputs are its inputs as they lie".into(),
            });
        }
        reach.check(contract, &blueprint, entry, &lowered)?;
        let placed = plan(&lowered);
        verify(&lowered, &placed).map_err(|fault| CompileError::Plan {
            program: entry.name.as_str().into(),
            fault,
        })?;
        programs.push(ProgramReport {
            name: entry.name.clone(),
            entry: entry.graph().unwrap_or("").into(),
            ops: placed.ops.len(),
            arena_len: placed.arena_len as usize,
            arena_lower_bound: placed.lower_bound as usize,
            layers: lowered.layers,
        });
        made.push(Made {
            entry: index,
            placed,
            tokens: lowered.tokens,
        });
    }
    known_parts(&storage, &signatures, &programs)?;
    let words = match signatures
        .iter()
        .find(|known| known.entry == LOOKUP_INSTRUCTION)
    {
        Some(signature) => {
            let dim = contract.words().map_or(0, |[_, dim]| dim);
            let mut all = vec![];
            for words in instruction_words(bundle, &model, signature)? {
                let span = weights.store(&words).map_err(in_lookup)?;
                all.push(((words.len() / dim) as u32, span));
            }
            all
        }
        None => vec![],
    };
    let mut parts = Parts {
        blueprint: &blueprint,
        caches: &caches,
        made: &made,
        words: &words,
        weights: &weights.data,
        tolerance: options.tolerance.unwrap_or(bundle.golden().tolerance),
        work: 0,
    };
    let weight_bytes = weights.data.len() * 4;
    let report = |cache_len| CompileReport {
        programs: programs.clone(),
        weight_bytes,
        cache_len,
    };
    // What the worst step costs is for the core to count: it is asked with an image that says nothing, and told what it counted.
    parts.work = counted_work(&image::write(bundle, &parts, report(0))?)?;
    let cache_len = image::rows_len(&parts);
    let image = image::write(bundle, &parts, report(cache_len))?;
    let policy = Policy::new_checked(image.as_bytes()).map_err(CompileError::Image)?;
    if !storage.is_exact() && !options.force {
        gate(bundle, &policy, &storage, parts.tolerance)?;
    }
    Ok(image)
}

/// Returns the multiply-adds of the worst step of an image that states none.
fn counted_work(draft: &Image) -> Result<u64, CompileError> {
    match Policy::new_within(draft.as_bytes(), u64::MAX) {
        Err(PolicyError::Schedule(ScheduleError::Work { counted, .. })) => Ok(counted),
        // Numbers of draws follow from the schedule, so the image is the first to know them.
        Err(PolicyError::Golden) => {
            let problem = "its `noise` has another number of draws in a step than the policy";
            Err(CompileError::Bundle(BundleError::Golden {
                problems: vec![problem.into()],
            }))
        }
        Err(error) => Err(CompileError::Image(error)),
        Ok(_) => Ok(0),
    }
}

/// Refuses exceptions for entries and layers that do not exist.
fn known_parts(
    storage: &Storage,
    signatures: &[Signature],
    programs: &[ProgramReport],
) -> Result<(), CompileError> {
    let layers = programs.iter().flat_map(|program| &program.layers);
    let known: HashSet<&str> = signatures
        .iter()
        .map(|signature| signature.entry.as_str())
        .chain(layers.map(|layer| layer.node.as_str()))
        .collect();
    let parts = storage.parts.keys().map(String::as_str);
    let unknown: Vec<_> = parts.filter(|part| !known.contains(part)).collect();
    if unknown.is_empty() {
        return Ok(());
    }
    Err(CompileError::UnknownParts {
        parts: unknown.join(", ").into(),
    })
}

/// Refuses more f32 elements of memory than a policy may have.
fn bounded(elements: usize) -> Result<(), CompileError> {
    let bytes = elements.saturating_mul(size_of::<f32>());
    if bytes > Policy::MEMORY_LIMIT {
        return Err(CompileError::Excessive { bytes });
    }
    Ok(())
}

/// Refuses an image that does not replay the golden episode, for its formats only if they are the
/// reason.
fn gate(
    bundle: &Bundle,
    policy: &Policy,
    storage: &Storage,
    tolerance: f32,
) -> Result<(), CompileError> {
    let Err(error) = replay(policy)? else {
        return Ok(());
    };
    let exact = compile_with(bundle, &Options::exact())?;
    let exact = Policy::new_checked(exact.as_bytes()).map_err(CompileError::Image)?;
    if let Err(error) = replay(&exact)? {
        return Err(CompileError::Unlike { error });
    }
    Err(CompileError::Gate {
        stored: storage.to_string().into(),
        error,
        tolerance,
    })
}

/// Replays the golden episode, in memory of its own.
fn replay(policy: &Policy) -> Result<Result<(), SelfTestError>, CompileError> {
    bounded(policy.arena_len().saturating_add(policy.state_len()))?;
    let mut arena = vec![0.0; policy.arena_len()];
    let mut state = vec![0.0; policy.state_len()];
    let workspace = Workspace::new(policy, &mut arena, &mut state).map_err(|small| {
        CompileError::Excessive {
            bytes: small.needed.saturating_mul(size_of::<f32>()),
        }
    })?;
    let replayed = Controller::new(*policy, workspace).self_test();
    Ok(replayed.map(|_| ()))
}

/// Sizes the KV caches for the rows that the longest context takes.
fn caches(
    bundle: &Bundle,
    blueprint: &Blueprint,
    signatures: &[Signature],
    format: CacheFormat,
) -> Result<HashMap<String, Cache>, CompileError> {
    let tokens = |entry: &Entry| {
        let signature = signatures
            .iter()
            .find(|signature| Some(signature.entry.as_str()) == entry.graph());
        signature.map_or(0, Signature::tokens)
    };
    let rows = blueprint.rows(bundle.contract(), tokens);
    let mut caches = HashMap::new();
    let mut elements = 0_usize;
    for (state, rows) in blueprint.states.iter().zip(rows) {
        let Keep::Kv(network) = state.keep else {
            continue;
        };
        let cache = Cache::new(network, rows, format);
        let len = cache.len().ok_or_else(|| CompileError::TooLarge {
            what: "the KV cache".into(),
        })?;
        // Before the compiler itself takes memory that grows with the context.
        elements = elements.saturating_add(len as usize);
        bounded(elements)?;
        caches.insert(state.name.clone(), cache);
    }
    Ok(caches)
}

/// Returns the graph of an entry, ready to be lowered; `None` for one that the bundle leaves out.
fn fused(
    model: &Model,
    signatures: &[Signature],
    blueprint: &Blueprint,
    entry: &Entry,
) -> Result<Option<Fused>, CompileError> {
    match &entry.origin {
        Origin::Graph(graph) => {
            let Some(signature) = signatures.iter().find(|known| known.entry == *graph) else {
                return Ok(None);
            };
            let imported = model.import(signature, &HashMap::new())?;
            fuse(imported, signature, &entry.outputs).map(Some)
        }
        Origin::Copy { channel } => {
            let output = entry.outputs.first().map_or("", String::as_str);
            let name = output.strip_prefix("next_").unwrap_or(output);
            let state = blueprint.states.iter().find(|state| state.name == name);
            let width = state
                .and_then(|state| state.width.as_ref())
                .map_or(0, |wide| wide.0);
            Ok(Some(Fused::copy(
                channel,
                output,
                &[Dim::of(1), Dim::of(width)],
            )))
        }
    }
}

/// Returns the word embeddings of every known instruction, `[words, elements]` each, in the
/// contract's order, by evaluating the bundle's table; empty for a policy without instructions.
pub fn words(bundle: &Bundle) -> Result<Vec<Vec<f32>>, CompileError> {
    let contract = bundle.contract();
    let blueprint = contract.family.kind().blueprint(contract);
    let signatures =
        entries::signatures(bundle.graph(), contract, &blueprint).map_err(CompileError::Bundle)?;
    let model = Model::new(&bundle.model, bundle.graph())?;
    let lookup = signatures
        .iter()
        .find(|known| known.entry == LOOKUP_INSTRUCTION);
    lookup.map_or(Ok(vec![]), |signature| {
        instruction_words(bundle, &model, signature)
    })
}

fn in_lookup(problem: String) -> CompileError {
    CompileError::Entry {
        entry: LOOKUP_INSTRUCTION.into(),
        problem: problem.into(),
    }
}

/// Computes the words of every known instruction by evaluating the entry for each id.
fn instruction_words(
    bundle: &Bundle,
    model: &Model,
    signature: &Signature,
) -> Result<Vec<Vec<f32>>, CompileError> {
    let contract = bundle.contract();
    let [most, dim] = contract.words().unwrap_or_default();
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
            return Err(in_lookup(format!(
                "it is not a table: instruction {} does not evaluate to constants",
                known.id
            )));
        };
        let length = usize::try_from(length)
            .ok()
            .filter(|length| (1..=most).contains(length));
        let length = length.ok_or_else(|| {
            in_lookup(format!(
                "instruction {} has no length from 1 to the {most} words of its channel",
                known.id
            ))
        })?;
        if words.iter().any(|x| !x.is_finite()) {
            return Err(in_lookup(format!(
                "the words of instruction {} are not finite",
                known.id
            )));
        }
        all.push(words[..length * dim].to_vec());
    }
    Ok(all)
}
