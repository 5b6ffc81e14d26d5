//! Checks whether a bundle's contract fits an environment. Every difference is refused by name, before anything moves.
//!
//! A policy that is driven with the elements of its observation in another order, or at another rate, does not fail: it moves the wrong
//! joint. So id, version, control period and every element must agree, and every sub-task must be one that is watched. Environments name
//! an element after its joint where the joint has one coordinate, so an element agrees by its name or by its joint. A policy with cameras
//! may observe the first elements only: the robot's own, while it sees the rest.

use lads_compiler::Contract;
use lads_compiler::contract::{Channel, DType, Element};
use thiserror::Error;

use crate::environment::Environment;
use crate::sight::{self, SightError};

/// Relative difference up to which two control periods count as equal: four times the rounding of the contract's `f32`.
const PERIOD_TOLERANCE: f64 = 2.4e-7;

/// The first difference between a contract and an environment.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum Misfit {
    /// A text differs: the environment's id or version.
    #[error("the contract's {field} is '{contract}', the environment's is '{environment}'")]
    Text {
        /// Name of the contract's field.
        field: &'static str,
        /// The contract's value.
        contract: String,
        /// The environment's value.
        environment: String,
    },
    /// The control periods differ.
    #[error("the contract's control_period_s is {contract}, the environment's is {environment}")]
    ControlPeriod {
        /// The contract's control period, in seconds.
        contract: f64,
        /// The environment's control period, in seconds.
        environment: f64,
    },
    /// The policy observes something other than one vector.
    #[error(
        "the contract's observation channels are {contract}, the environment gives one vector of numbers and its cameras' frames"
    )]
    Channels {
        /// Names of the contract's observation channels.
        contract: String,
    },
    /// Images are of something that no camera of the environment shows.
    #[error(transparent)]
    Images(#[from] SightError),
    /// Observation or action have different lengths.
    #[error("the contract's {field} has {contract} elements, the environment's has {environment}")]
    Len {
        /// Name of the contract's field.
        field: &'static str,
        /// Elements in the contract.
        contract: usize,
        /// Elements in the environment.
        environment: usize,
    },
    /// An element of observation or action has another name.
    #[error(
        "element {index} of the contract's {field} is '{contract}', the environment's is '{environment}'"
    )]
    Name {
        /// Name of the contract's field.
        field: &'static str,
        /// Index of the element, from 0.
        index: usize,
        /// Element's name in the contract.
        contract: String,
        /// Element's name in the environment.
        environment: String,
    },
    /// An instruction commands a sub-task that the environment does not watch.
    #[error(
        "instruction '{instruction}' of the contract commands '{sub_task}', which the environment does not know"
    )]
    SubTask {
        /// Id of the instruction.
        instruction: String,
        /// The unknown sub-task.
        sub_task: String,
    },
}

/// Compares `contract` with `environment`; returns, for each instruction of the contract, the environment's indices of the sub-tasks that
/// it commands.
pub fn check(
    contract: &Contract,
    environment: &dyn Environment,
) -> Result<Vec<Vec<usize>>, Misfit> {
    same_text("environment.id", &contract.environment.id, environment.id())?;
    same_text(
        "environment.version",
        &contract.environment.version,
        environment.version(),
    )?;
    let (period, simulated) = (
        f64::from(contract.control_period_s),
        environment.control_period_s(),
    );
    let difference = (period - simulated).abs();
    if difference.is_nan() || difference > PERIOD_TOLERANCE * simulated {
        return Err(Misfit::ControlPeriod {
            contract: period,
            environment: simulated,
        });
    }
    sight::renderings(contract)?;
    let mut vectors = contract.observations().filter(|it| !sight::is_image(it));
    let (observation, more) = (vectors.next(), vectors.next());
    if more.is_some() || observation.is_some_and(|channel| channel.dtype != DType::F32) {
        let names = contract.observations().map(|channel| channel.name.as_str());
        return Err(Misfit::Channels {
            contract: names.collect::<Vec<_>>().join(", "),
        });
    }
    if let Some(observation) = observation {
        let names = environment.observation_names();
        let own = (contract.observations().any(sight::is_image)).then_some(&observation.elements);
        let own = own.and_then(|own| names.get(..own.len()));
        same_elements("observation", observation, own.unwrap_or(names))?;
    }
    same_elements("action", contract.action(), environment.action_names())?;
    contract
        .instructions
        .iter()
        .enumerate()
        .map(|(index, known)| {
            let (sub_tasks, _) = contract.evaluated(index);
            let sub_tasks = sub_tasks.iter();
            sub_tasks
                .map(|name| index_of(&known.id, name, environment))
                .collect()
        })
        .collect()
}

/// Splits a comma-separated list of sub-tasks, as a person writes it, into names.
pub fn sub_tasks(list: &str) -> impl Iterator<Item = &str> {
    list.split(',')
        .map(str::trim)
        .filter(|name| !name.is_empty())
}

fn index_of(
    instruction: &str,
    sub_task: &str,
    environment: &dyn Environment,
) -> Result<usize, Misfit> {
    let place = environment
        .sub_tasks()
        .iter()
        .position(|&known| known == sub_task);
    place.ok_or_else(|| Misfit::SubTask {
        instruction: instruction.to_owned(),
        sub_task: sub_task.to_owned(),
    })
}

fn same_text(field: &'static str, contract: &str, environment: &str) -> Result<(), Misfit> {
    if contract == environment {
        return Ok(());
    }
    Err(Misfit::Text {
        field,
        contract: contract.to_owned(),
        environment: environment.to_owned(),
    })
}

fn same_elements(
    field: &'static str,
    channel: &Channel,
    environment: &[&str],
) -> Result<(), Misfit> {
    let contract = &channel.elements;
    if contract.len() != environment.len() {
        return Err(Misfit::Len {
            field,
            contract: contract.len(),
            environment: environment.len(),
        });
    }
    let differs = |element: &Element, name: &str| {
        element.name != name && element.joint.as_deref() != Some(name)
    };
    let mut pairs = contract.iter().zip(environment).enumerate();
    match pairs.find(|(_, (element, name))| differs(element, name)) {
        None => Ok(()),
        Some((index, (element, name))) => Err(Misfit::Name {
            field,
            index,
            contract: element.name.clone(),
            environment: (*name).to_owned(),
        }),
    }
}
