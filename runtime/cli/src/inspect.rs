//! `lads inspect`: what a policy expects and promises, what its programs are, and how much memory it takes.
//!
//! Everything is read from the compiled image, so a bundle and the image made from it give the same report, but for the file's name.

use std::fmt::{self, Display, Formatter};

use lads_core::image::{Beyond, PolicyKind, ProgramKind};
use lads_core::op::Port;
use lads_core::{Contract, Decision, Element, GuardedController, Interval, Policy, Program};
use serde_json::{Value, json};

use crate::line::{self, Form};
use crate::model::Model;
use crate::refusal::Refusal;

/// The observations of the golden episode as lines of CSV, the shortest decimal form of each element.
pub fn observations(model: &Model) -> Result<String, Refusal> {
    let policy = model.policy()?;
    let golden = policy.golden().ok_or_else(|| {
        Refusal::new(
            model.path.display(),
            "it carries no golden episode, so there are no observations to show",
            "export the bundle with one",
        )
    })?;
    let (mut text, mut row) = (String::new(), String::new());
    for (observation, _, _) in golden.steps() {
        line::format(Form::Csv, observation, None, &mut row);
        text.push_str(&row);
    }
    Ok(text)
}

/// A policy that can describe itself, for people or as JSON.
pub struct Report<'m> {
    model: &'m Model,
    policy: Policy<'m>,
    contract: Contract<'m>,
}

impl<'m> Report<'m> {
    /// The report on a policy that was read.
    pub fn of(model: &'m Model) -> Result<Self, Refusal> {
        let policy = model.policy()?;
        Ok(Self {
            model,
            policy,
            contract: policy.contract(),
        })
    }

    /// Everything as one JSON object; lengths count elements, sizes are in bytes.
    pub fn json(&self) -> Value {
        let contract = &self.contract;
        let network = contract.network();
        json!({
            "file": self.model.path.display().to_string(),
            "form": self.form(),
            "bundle_sha256": contract.bundle_sha256(),
            "contract": {
                "kind": kind(contract),
                "environment": { "id": contract.environment_id(), "version": contract.environment_version() },
                "control_period_s": decimal(contract.control_period_s()),
                "horizon": contract.horizon(),
                "codebook": { "size": contract.codebook_len(), "dim": contract.plan_len() },
                "decision": decision_json(contract.decision()),
                "context": {
                    "words": contract.words_len(),
                    "steps": contract.context_steps(),
                    "beyond": beyond(contract.beyond()),
                },
                "network": { "layers": network.layers, "heads": network.heads, "head_dim": network.head_dim },
                "language": {
                    "encoder": contract.encoder(),
                    "sha256": contract.encoder_sha256(),
                    "dim": contract.word_dim(),
                },
                "observation": contract.observations().map(element_json).collect::<Vec<_>>(),
                "action": contract.actions().map(element_json).collect::<Vec<_>>(),
                "instructions": self.instructions_json(),
            },
            "entries": self.entries().map(|(name, program)| entry_json(name, program)).collect::<Vec<_>>(),
            "sizes": {
                "image_bytes": self.policy.image_bytes(),
                "weights_bytes": self.weights_bytes(),
                "workspace_bytes": lads_ffi::workspace_bytes(&self.policy),
                "arena_bytes": bytes(self.policy.arena_len()),
                "state_bytes": bytes(self.policy.state_len()),
                "guard_bytes": bytes(GuardedController::memory_len(&self.policy)),
                "stack_bytes": lads_ffi::LADS_STACK_BYTES,
            },
            "golden_steps": self.policy.golden().map(|golden| golden.len()),
        })
    }

    fn instructions_json(&self) -> Vec<Value> {
        let json = |known: lads_core::KnownInstruction<'_>| {
            let sub_tasks: Vec<_> = known.sub_tasks.split(',').map(str::trim).collect();
            json!({
                "id": known.id,
                "text": known.text,
                "sub_tasks": sub_tasks,
                "split": known.split,
                "words": known.words.len() / self.contract.word_dim(),
            })
        };
        self.contract.instructions().map(json).collect()
    }

    fn form(&self) -> &'static str {
        if self.model.is_bundle() {
            "bundle"
        } else {
            "image"
        }
    }

    /// The programs that the image has, by the name of the bundle's entry and, for its variants, what they are for.
    fn entries(&self) -> impl Iterator<Item = (&'static str, &Program<'m>)> {
        let named = ProgramKind::ALL
            .iter()
            .map(|&kind| (entry_name(kind), self.policy.program(kind)));
        named.filter(|(_, program)| !program.is_empty())
    }

    fn weights_bytes(&self) -> usize {
        size_of_val(self.policy.weights())
    }
}

impl Display for Report<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let contract = &self.contract;
        let (network, path) = (contract.network(), self.model.path.display());
        let [id, version] = [contract.environment_id(), contract.environment_version()];
        writeln!(
            f,
            "{path}: {:?} policy for {id} {version} ({})",
            contract.kind(),
            self.form()
        )?;
        writeln!(f, "bundle sha256   {}", contract.bundle_sha256())?;
        writeln!(f, "control period  {} s", contract.control_period_s())?;
        let [horizon, entries, len] = [
            contract.horizon(),
            contract.codebook_len(),
            contract.plan_len(),
        ];
        writeln!(
            f,
            "plans           every {horizon} steps one of {entries}, {len} elements each, {}",
            decision_text(contract.decision())
        )?;
        let [words, steps] = [contract.words_len(), contract.context_steps()];
        writeln!(
            f,
            "context         up to {words} words and {steps} steps, then {}",
            beyond(contract.beyond())
        )?;
        let lads_core::Network {
            layers,
            heads,
            head_dim,
        } = network;
        writeln!(
            f,
            "transformer     {layers} layers, {heads} heads of {head_dim}"
        )?;
        writeln!(
            f,
            "language        {}, {} elements a word",
            contract.encoder(),
            contract.word_dim()
        )?;
        match self.policy.golden() {
            Some(golden) => writeln!(
                f,
                "golden episode  {} steps, tolerance {:.0e}",
                golden.len(),
                golden.tolerance()
            )?,
            None => writeln!(
                f,
                "golden episode  none: the self-test has nothing to replay"
            )?,
        }
        elements("observation", contract.observations(), f)?;
        elements("action", contract.actions(), f)?;
        self.instructions(f)?;
        self.programs(f)?;
        self.sizes(f)
    }
}

impl Report<'_> {
    fn instructions(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(f, "\ninstructions ({})", self.contract.instruction_count())?;
        for known in self.contract.instructions() {
            writeln!(f, "  {:<8} {:<6} {}", known.id, known.split, known.text)?;
        }
        Ok(())
    }

    fn programs(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "\nentry                          ops  arena [B]  inputs → outputs"
        )?;
        for (name, program) in self.entries() {
            let (inputs, effects) = (inputs(program).join(", "), effects(program));
            let (ops, arena) = (program.ops().count(), bytes(program.arena_len()));
            writeln!(f, "  {name:<26} {ops:>5} {arena:>10}  {inputs} → {effects}")?;
        }
        Ok(())
    }

    fn sizes(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(f, "\nsizes [B]")?;
        writeln!(
            f,
            "  image      {:>9}, of which weights {}",
            self.policy.image_bytes(),
            self.weights_bytes()
        )?;
        let [arena, state] = [self.policy.arena_len(), self.policy.state_len()].map(bytes);
        let guard = bytes(GuardedController::memory_len(&self.policy));
        let workspace = lads_ffi::workspace_bytes(&self.policy);
        writeln!(
            f,
            "  workspace  {workspace:>9}: arena {arena}, state {state}, guard {guard}, the rest controller and alignment"
        )?;
        writeln!(
            f,
            "  stack      {:>9}, measured with the static library on x86-64",
            lads_ffi::LADS_STACK_BYTES
        )
    }
}

fn elements<'c>(
    title: &str,
    elements: impl Iterator<Item = Element<'c>>,
    f: &mut Formatter<'_>,
) -> fmt::Result {
    let elements: Vec<_> = elements.collect();
    writeln!(f, "\n{title} ({})", elements.len())?;
    for (
        index,
        Element {
            name,
            unit,
            joint,
            limits: Interval { min, max },
        },
    ) in elements.iter().enumerate()
    {
        let joint = if joint.is_empty() {
            String::new()
        } else {
            format!("  joint {joint}")
        };
        writeln!(
            f,
            "  {index:>3} {name:<26} {min:>8} to {max:<8} {unit:<4}{joint}"
        )?;
    }
    Ok(())
}

fn kind(contract: &Contract<'_>) -> &'static str {
    match contract.kind() {
        PolicyKind::Lads => "lads",
    }
}

fn port_name(port: Port) -> &'static str {
    match port {
        Port::Observation => "observation",
        Port::Action => "action",
        Port::Words => "words",
        Port::Timestep => "timestep",
        Port::Plan => "plan",
        Port::PlanIndex => "plan_index",
        Port::Logits => "logits",
        Port::Latent => "latent",
        Port::Observations => "observations",
        Port::Actions => "actions",
        Port::InstructionId => "instruction_id",
    }
}

fn entry_name(kind: ProgramKind) -> &'static str {
    match kind {
        ProgramKind::Instruct => "high_level/instruct",
        ProgramKind::Start => "high_level/start",
        ProgramKind::StepDecide => "high_level/step (decide)",
        ProgramKind::StepRecord => "high_level/step (record)",
        ProgramKind::Lookup => "codebook/lookup",
        ProgramKind::Act => "low_level/act",
        ProgramKind::Encode => "trajectory_encoder/encode",
    }
}

fn inputs(program: &Program<'_>) -> Vec<&'static str> {
    program.inputs().map(|port| port_name(port.port)).collect()
}

fn outputs(program: &Program<'_>) -> Vec<&'static str> {
    program.outputs().map(|port| port_name(port.port)).collect()
}

/// The outputs and, after them, what the program leaves in the KV cache.
fn effects(program: &Program<'_>) -> String {
    let tokens = program.tokens();
    let cached = (tokens > 0).then(|| format!("KV of {tokens} tokens"));
    let outputs = outputs(program).into_iter().map(str::to_owned);
    outputs.chain(cached).collect::<Vec<_>>().join(", ")
}

fn entry_json(name: &str, program: &Program<'_>) -> Value {
    json!({
        "name": name,
        "ops": program.ops().count(),
        "arena_bytes": bytes(program.arena_len()),
        "tokens": program.tokens(),
        "inputs": inputs(program),
        "outputs": outputs(program),
    })
}

fn element_json(element: Element<'_>) -> Value {
    let Element {
        name,
        unit,
        joint,
        limits: Interval { min, max },
    } = element;
    // Through the shortest decimal form: 0.16_f32 is 0.16 in the JSON too.
    json!({ "name": name, "unit": unit, "joint": joint, "min": decimal(min), "max": decimal(max) })
}

/// An f32 as the f64 of its shortest decimal form.
fn decimal(value: f32) -> f64 {
    value
        .to_string()
        .parse()
        .unwrap_or_else(|_| f64::from(value))
}

fn decision_json(decision: Decision) -> Value {
    match decision {
        Decision::Argmax => json!({ "rule": "argmax" }),
        Decision::Sample { temperature, seed } => {
            json!({ "rule": "sample", "temperature": decimal(temperature), "seed": seed })
        }
    }
}

fn decision_text(decision: Decision) -> String {
    match decision {
        Decision::Argmax => "the likeliest".to_owned(),
        Decision::Sample { temperature, seed } => {
            format!("sampled at temperature {temperature} with seed {seed}")
        }
    }
}

fn beyond(beyond: Beyond) -> &'static str {
    match beyond {
        Beyond::Restart => "restart",
        Beyond::Refuse => "refuse",
    }
}

fn bytes(len: usize) -> usize {
    len * size_of::<f32>()
}
