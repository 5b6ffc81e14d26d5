//! The policy as it will be: channels of the caller, what each input of the graphs is made of, states, the action.
//!
//! Made by [`resolve`](crate::resolve) of what the graphs are and what was said, complete and free of contradictions.

use crate::model::Edge;
use crate::robot::{Layout, Order, QuaternionOrder, Start, Wave};

/// An element of a channel, as the contract has it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Element {
    pub name: String,
    pub unit: String,
    pub min: f64,
    pub max: f64,
    pub joint: Option<String>,
    pub interface: Option<String>,
    pub stiffness: Option<f64>,
    pub damping: Option<f64>,
}

/// An observation channel.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Channel {
    pub name: String,
    pub elements: Vec<Element>,
    /// Which elements each term brought, in their order.
    pub parts: Vec<Part>,
    pub quaternion_order: Option<QuaternionOrder>,
}

/// The elements of a channel that a term brought: `first..first + len`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Part {
    pub term: String,
    pub first: usize,
    pub len: usize,
}

/// Where the raw values of a term come from.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Source {
    /// Columns of a channel, in the graph's order.
    Columns { channel: usize, columns: Vec<usize> },
    /// The columns `w, x, y, z` of an orientation.
    Gravity { channel: usize, columns: [usize; 4] },
    /// The last raw action.
    Action,
    /// Sine or cosine, ahead by a part of a turn; the clock turns by so many radians in a control step.
    Phase { turn: f64, hands: Vec<(Wave, f64)> },
    /// Control steps since the episode began.
    Step,
    /// 1 in the first step.
    First,
    /// Another output of the graphs.
    Output(Edge),
}

/// Lowest and highest value of each element.
pub(crate) type Bounds = (Vec<f64>, Vec<f64>);

/// A part of an input: `clip(raw - offset) * scale`, of the last steps.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Term {
    pub name: String,
    pub source: Source,
    pub offset: Vec<f64>,
    pub clip: Option<Bounds>,
    pub scale: Vec<f64>,
    pub history: usize,
}

impl Term {
    pub fn width(&self) -> usize {
        self.scale.len()
    }
}

/// How terms of several steps are put together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Stack {
    pub layout: Layout,
    pub order: Order,
    pub start: Start,
}

/// What an input of a graph is made of.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Feed {
    Terms {
        terms: Vec<Term>,
        stack: Stack,
        clip: Option<Bounds>,
    },
    /// What the output of that number gave in the last step.
    State(usize),
    Constant(f64),
    /// Another graph's output.
    Wire(Edge),
}

/// The action: `clip(raw) * scale + offset`, then in the robot's order.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Action {
    pub edge: Edge,
    pub clip: Option<Bounds>,
    pub scale: Vec<f64>,
    pub offset: Vec<f64>,
    /// For each element that the robot gets, its index in the policy's order.
    pub order: Vec<usize>,
    /// In the robot's order.
    pub elements: Vec<Element>,
    pub reference: String,
}

/// A state that the graphs themselves have.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct State {
    pub input: Edge,
    pub output: Edge,
}

/// All of it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Plan {
    pub environment: (String, String),
    pub period: f64,
    pub channels: Vec<Channel>,
    pub feeds: Vec<(Edge, Feed)>,
    pub states: Vec<State>,
    pub action: Action,
    /// Largest difference of an action that counts as equal, where a person says one.
    pub tolerance: Option<f64>,
}
