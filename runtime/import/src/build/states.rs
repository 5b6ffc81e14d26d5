//! States of the bundle: those of the policy's graphs, and those that the terms need.

/// A state in the contract's form.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Kept {
    /// Values replaced as a whole in each step; zeros at first.
    Plain { name: String, shape: Vec<usize> },
    /// Ring of the last rows of a channel; the first row stands for those before it.
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

/// Returns the name of a state of the policy's own graphs.
pub(super) fn name(number: usize) -> String {
    format!("state.{number}")
}
