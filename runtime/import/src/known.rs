//! Observation terms whose meaning the frameworks define: Isaac Lab, mjlab and unitree's tools use
//! the same names.
//!
//! Only facts that follow from the definition are listed here. A person states the limits of a
//! sensor, and the meaning of a command.

use crate::robot::{Each, From, Term};

/// Facts about a term that follow from its name.
pub(crate) struct Known {
    pub term: Term,
    /// True if joint positions are relative to the default posture, by definition.
    pub relative: bool,
}

/// Looks a term up.
pub(crate) fn known(name: &str) -> Option<Known> {
    let mut term = Term::default();
    let mut relative = false;
    let text = |text: &str| Some(text.to_owned());
    match name {
        "base_ang_vel" => vector(&mut term, "rad/s"),
        "base_lin_vel" => vector(&mut term, "m/s"),
        // Of unit length, with a margin for the rounding of the program that computes it.
        "projected_gravity" => {
            vector(&mut term, "1");
            term.min = Some(Each::One(-1.01));
            term.max = Some(Each::One(1.01));
        }
        "joint_pos" | "joint_pos_rel" | "dof_pos" => {
            relative = name == "joint_pos_rel";
            term.per_joint = Some(true);
            term.unit = text("rad");
            term.interface = text("position");
        }
        "joint_vel" | "joint_vel_rel" | "dof_vel" => {
            term.per_joint = Some(true);
            term.unit = text("rad/s");
            term.interface = text("velocity");
        }
        "actions" | "last_action" | "last_actions" | "prev_action" | "prev_actions" => {
            term.from = Some(From::Action);
        }
        "velocity_commands" | "command" | "commands" | "base_velocity" | "twist" => {
            term.channel = text("command");
        }
        _ => return None,
    }
    Some(Known { term, relative })
}

fn vector(term: &mut Term, unit: &str) {
    term.width = Some(3);
    term.elements = Some(["x", "y", "z"].map(str::to_owned).to_vec());
    term.unit = Some(unit.into());
}
