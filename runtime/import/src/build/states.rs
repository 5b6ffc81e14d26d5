//! States of the bundle: those of the policy's graphs, and those that the terms need.

/// A state as the contract has it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Kept {
    /// Taken over as a whole from one step to the next; zeros at first.
    Plain { name: String, shape: Vec<usize> },
    /// The last rows of a channel; the first one stands for those before it.
    Ring {
        name: String,
        rows: usize,
        source: String,
    },
}

impl Kept {
    pub fn plain(name: &str, shape: &[usize]) -> Self {
        Kept::Plain {
            name: name.into(),
            shape: shape.to_vec(),
        }
    }
}

/// The name of a state of the policy's own graphs.
pub(super) fn name(number: usize) -> String {
    format!("state.{number}")
}
