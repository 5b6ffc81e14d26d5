//! Plain policies: one graph from observations to an action, memoryless, recurrent, or over the
//! last observations.
//!
//! The contract's `states` describe the graph's memory. A ring with a source gets that channel's
//! values appended before the graph runs, by a program of its own that only copies.

use lads_image::records::{self, Scope};
use serde::Deserialize;

use super::{Blueprint, Call, Entry, Keep, Kind, Origin};
use crate::contract::{
    Channel, ClearedBy, Contract, Faults, Fill, Role, StateKind, roles_are_known,
};

/// Name of the only graph.
const ACT: &str = "policy/act";

/// Every field of this family in a contract.
pub(crate) const EXAMPLE: &str = r#"{"kind": "plain"}"#;

/// Contract fields of a plain policy, which has none of its own.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Plain {}

impl Kind for Plain {
    fn check(&self, contract: &Contract, faults: &mut Faults) {
        if contract.with(Role::Instruction).next().is_some() && roles_are_known(contract, faults) {
            faults.add(
                "channels",
                "has an instruction, and family plain takes none",
            );
        }
    }

    fn blueprint(&self, contract: &Contract) -> Blueprint {
        let mut blueprint = Blueprint::default();
        let mut outputs = vec!["action".to_owned()];
        for state in &contract.states {
            let scope = match state.cleared_by {
                ClearedBy::Episode => Scope::Episode,
                ClearedBy::Instruction => Scope::Instruction,
            };
            let keep = match state.kind {
                StateKind::Plain => {
                    outputs.push(format!("next_{}", state.name));
                    Keep::Plain
                }
                StateKind::Ring => Keep::Ring {
                    rows: state.rows,
                    fill: match state.fill {
                        Fill::Zero => records::Fill::Zero,
                        Fill::First => records::Fill::First,
                    },
                },
            };
            let product = |len: usize, &dim| len.saturating_mul(dim);
            let (width, field) = match &state.source {
                Some(channel) => (
                    contract.channel(channel).map_or(0, Channel::len),
                    "channels",
                ),
                None => (state.shape.iter().fold(1, product), "states"),
            };
            blueprint = blueprint.state(&state.name, keep, scope).wide(width, field);
            if let Some(channel) = &state.source {
                let append = format!("{}/append", state.name);
                blueprint = blueprint
                    .entry(Entry {
                        origin: Origin::Copy {
                            channel: channel.clone(),
                        },
                        ..Entry::variant(&append, "", &[&format!("next_{}", state.name)])
                    })
                    .call(Call::step(&append));
            }
        }
        let outputs: Vec<&str> = outputs.iter().map(String::as_str).collect();
        blueprint
            .entry(Entry::new(ACT, &outputs).acts())
            .call(Call::step(ACT))
    }
}
