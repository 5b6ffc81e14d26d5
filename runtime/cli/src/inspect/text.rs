//! Report of `lads inspect` as text, for people.

use std::fmt::{self, Display, Formatter};

use lads_core::{Channel, GuardedController, Interval};
use lads_host::schedule::{Call, Cost, Place, Steps};
use lads_image::records::{Event, StateKind};

use super::{Report, beyond, bytes, decision, dtype, noise, quaternions, role};

impl Display for Report<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let contract = self.policy.contract();
        let path = self.path.display();
        let [id, version] = [contract.environment_id(), contract.environment_version()];
        let (family, form) = (contract.family(), self.form());
        writeln!(f, "{path}: {family} policy for {id} {version} ({form})")?;
        writeln!(f, "bundle sha256   {}", contract.bundle_sha256())?;
        writeln!(f, "control period  {} s", contract.control_period_s())?;
        match contract.context_steps() {
            Some(steps) => writeln!(
                f,
                "context         {steps} steps, then {}",
                beyond(contract.beyond())
            )?,
            None => writeln!(f, "context         without end")?,
        }
        if self.policy.index_count() > 0 {
            let rule = decision(contract.decision());
            writeln!(
                f,
                "selects         {rule}, of {}",
                self.policy.index_count()
            )?;
        }
        if self.policy.noise_len() > 0 {
            let (rule, len) = (noise(contract.noise()), self.policy.noise_len());
            writeln!(f, "noise           {rule}, {len} elements a step at most")?;
        }
        if contract.instruction_channel().is_some() {
            let (words, dim) = (contract.words_len(), contract.word_dim());
            let encoder = contract.encoder();
            writeln!(
                f,
                "language        {encoder}, up to {words} words of {dim} elements"
            )?;
        }
        writeln!(f, "stored          {}", lads_host::stored(&self.policy))?;
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
        for channel in contract.channels() {
            write_channel(&channel, f)?;
        }
        self.write_instructions(f)?;
        self.write_schedule(f)?;
        self.write_entries(f)?;
        self.write_states(f)?;
        self.write_sizes(f)
    }
}

impl Report<'_> {
    fn write_instructions(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let contract = self.policy.contract();
        if contract.instruction_count() == 0 {
            return Ok(());
        }
        writeln!(f, "\ninstructions ({})", contract.instruction_count())?;
        for known in contract.instructions() {
            writeln!(f, "  {:<8} {}", known.id, known.text)?;
        }
        Ok(())
    }

    fn write_schedule(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let columns = ["multiply-adds", "weights [B]", "states [B]"];
        let [work, weights, states] = columns;
        writeln!(
            f,
            "\n{:<50} {work:>14} {weights:>12} {states:>12}",
            "schedule: what runs when, and what it reads"
        )?;
        for place in &self.places {
            write_costs(f, &place_name(place), place.cost())?;
            for call in &place.calls {
                write_costs(f, &call_name(call), call.cost)?;
            }
        }
        let worst = self.policy.contract().worst_work();
        writeln!(
            f,
            "  the worst step, or call of another event, counts {worst} multiply-adds and operations"
        )
    }

    fn write_entries(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "\nentry                          ops  arena [B]  inputs → outputs"
        )?;
        for entry in self.entries() {
            let name = |port: lads_image::records::PortRecord| {
                let (name, source) = (self.tables.text(port.name), self.source(&port));
                let plain = source.rsplit(' ').next() == Some(name);
                if plain {
                    name.to_owned()
                } else {
                    format!("{name} ({source})")
                }
            };
            let inputs: Vec<_> = self.tables.inputs(&entry).map(name).collect();
            let cached = self.cache(&entry).map(|cache| {
                let rows = if entry.tokens == 1 { "row" } else { "rows" };
                format!("{} {rows} of {cache}", entry.tokens)
            });
            let outputs = self.tables.outputs(&entry).map(name).chain(cached);
            let outputs: Vec<_> = outputs.collect();
            writeln!(
                f,
                "  {:<26} {:>5} {:>10}  {} → {}",
                self.tables.text(entry.name),
                entry.ops_len,
                bytes(entry.arena_len as usize),
                inputs.join(", "),
                outputs.join(", ")
            )?;
        }
        Ok(())
    }

    fn write_states(&self, f: &mut Formatter<'_>) -> fmt::Result {
        if self.tables.states_len() == 0 {
            return Ok(());
        }
        writeln!(
            f,
            "\nstate                      kind    rows  lasts for an       bytes"
        )?;
        for state in self.states() {
            let rows = match state.record.kind {
                StateKind::Plain => String::new(),
                _ => state.record.rows.to_string(),
            };
            let cleared = if state.cleared {
                "  cleared by calls"
            } else {
                ""
            };
            writeln!(
                f,
                "  {:<24} {:<6} {rows:>5}  {:<12} {:>11}{cleared}",
                state.name,
                state.kind(),
                state.scope(),
                state.bytes()
            )?;
        }
        Ok(())
    }

    fn write_sizes(&self, f: &mut Formatter<'_>) -> fmt::Result {
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
        let controller = Self::controller_bytes();
        writeln!(
            f,
            "  workspace  {workspace:>9}: arena {arena}, state {state}, guard {guard}, the rest bookkeeping of the C interface"
        )?;
        writeln!(
            f,
            "  controller {controller:>9}, besides arena and state, in Rust"
        )?;
        writeln!(
            f,
            "  stack      {:>9}, measured with the static library on x86-64",
            lads_ffi::stack_bytes(&self.policy)
        )
    }
}

fn write_costs(f: &mut Formatter<'_>, name: &str, cost: Cost) -> fmt::Result {
    let Cost {
        multiply_adds,
        weight_bytes,
        state_bytes,
    } = cost;
    writeln!(
        f,
        "  {name:<48} {multiply_adds:>14} {weight_bytes:>12} {state_bytes:>12}"
    )
}

fn place_name(place: &Place) -> String {
    match (place.event, place.steps) {
        (Event::Instruct, _) => "a new instruction".into(),
        (Event::Follow, _) => "an action for a given index".into(),
        (Event::Encode, _) => "a demonstration to encode".into(),
        (Event::Step, Steps::All) => "every step".into(),
        (Event::Step, Steps::First) => "the first step".into(),
        (Event::Step, Steps::Every(every)) => format!("every {every} steps"),
        (Event::Step, Steps::Other) => "other steps".into(),
    }
}

fn call_name(call: &Call) -> String {
    let mut name = format!("    {}", call.entry);
    if let Some(ring) = &call.per_row {
        name.push_str(" for each row of ");
        name.push_str(ring);
    } else if call.runs != 1 {
        name.push_str(" times ");
        name.push_str(&call.runs.to_string());
    }
    if !call.clears.is_empty() {
        name.push_str(", clears ");
        name.push_str(&call.clears.join(", "));
    }
    if let Some(scores) = &call.selects {
        name.push_str(", selects from ");
        name.push_str(scores);
    }
    name
}

fn write_channel(channel: &Channel<'_>, f: &mut Formatter<'_>) -> fmt::Result {
    let (name, role) = (channel.name(), role(channel.role()));
    let title = if name == role {
        name.to_owned()
    } else {
        format!("{role} {name}")
    };
    write!(
        f,
        "\n{title}: {} {:?}",
        dtype(channel.dtype()),
        channel.shape()
    )?;
    let order = quaternions(channel.quaternion_order());
    if order != "none" {
        write!(f, ", quaternions {order}")?;
    }
    if !channel.reference().is_empty() {
        write!(f, ", relative to: {}", channel.reference())?;
    }
    let mut elements = channel.elements().peekable();
    if elements.peek().is_none()
        && let Some(Interval { min, max }) = channel.limits().next()
        && (min > f32::MIN || max < f32::MAX)
    {
        write!(f, ", {min} to {max}")?;
    }
    writeln!(f)?;
    for (index, element) in elements.enumerate() {
        let Interval { min, max } = element.limits;
        write!(
            f,
            "  {index:>3} {:<26} {min:>8} to {max:<8} {:<6}",
            element.name, element.unit
        )?;
        if !element.joint.is_empty() {
            write!(f, " joint {}", element.joint)?;
        }
        if !element.interface.is_empty() {
            write!(f, " {}", element.interface)?;
        }
        if (element.scale, element.offset) != (1.0, 0.0) {
            write!(f, " = {} + {} * value", element.offset, element.scale)?;
        }
        if !element.physical_unit.is_empty() {
            write!(f, " in {}", element.physical_unit)?;
        }
        writeln!(f)?;
    }
    Ok(())
}
