//! Plan of the imported policy: channels of the caller, the composition of each input of the
//! graphs, states, the action.
//!
//! [`resolve`](crate::resolve) makes it of the graphs and the description, complete and free of
//! contradictions.

use crate::model::Edge;
use crate::robot::{Layout, Order, QuaternionOrder, Start, Wave};

/// An element of a channel, in the contract's form.
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
    /// Elements that each term contributed, in their order.
    pub parts: Vec<Part>,
    pub quaternion_order: Option<QuaternionOrder>,
}

/// Elements of a channel that a term contributed: `first..first + len`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Part {
    pub term: String,
    pub first: usize,
    pub len: usize,
}

/// Source of the raw values of a term.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Source {
    /// Columns of a channel, in the graph's order.
    Columns { channel: usize, columns: Vec<usize> },
    /// Direction of gravity, from the columns `w, x, y, z` of an orientation.
    Gravity { channel: usize, columns: [usize; 4] },
    /// Last raw action.
    Action,
    /// Sine or cosine of a clock, ahead by a part of a turn; the clock turns by so many radians in
    /// a control step.
    Phase { turn: f64, hands: Vec<(Wave, f64)> },
    /// Number of control steps since the episode began.
    Step,
    /// Indicator that is 1 in the first step.
    First,
    /// Value of another output of the graphs.
    Output(Edge),
}

/// Lowest and highest value of each element.
pub(crate) type Bounds = (Vec<f64>, Vec<f64>);

/// Part of an input: `clip(raw - offset) * scale`, of the last steps.
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

/// Layout of terms of several steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Stack {
    pub layout: Layout,
    pub order: Order,
    pub start: Start,
}

/// Composition of an input of a graph.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Feed {
    Terms {
        terms: Vec<Term>,
        stack: Stack,
        clip: Option<Bounds>,
    },
    /// Value of the output with this number in the last step.
    State(usize),
    Constant(f64),
    /// Output of another graph.
    Wire(Edge),
}

/// Action of the policy: `clip(raw) * scale + offset`, then in the robot's order.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Action {
    pub edge: Edge,
    pub clip: Option<Bounds>,
    pub scale: Vec<f64>,
    pub offset: Vec<f64>,
    /// Index in the policy's order of each element that the robot gets.
    pub order: Vec<usize>,
    /// Elements of the action, in the robot's order.
    pub elements: Vec<Element>,
    pub reference: String,
}

/// A state of the graphs themselves.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct State {
    pub input: Edge,
    pub output: Edge,
}

/// The complete plan of an import.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Plan {
    pub environment: (String, String),
    pub period: f64,
    pub channels: Vec<Channel>,
    pub feeds: Vec<(Edge, Feed)>,
    pub states: Vec<State>,
    pub action: Action,
    /// Largest difference of an action that counts as equal, if a person states one.
    pub tolerance: Option<f64>,
}
