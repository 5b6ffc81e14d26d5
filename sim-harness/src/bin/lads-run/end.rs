//! Ways in which a run ends, and where its output goes.

use std::fmt::Display;
use std::io::{ErrorKind, Write as _};
use std::path::Path;

use lads_sim::verify::reference::ReferenceError;

/// Why a run ends early.
pub enum End {
    /// Refused, with one line that names the thing and the remedy.
    Refused(String),
    /// Refused, with such a line for each thing.
    #[cfg_attr(
        not(feature = "report"),
        expect(dead_code, reason = "only `report` takes several files")
    )]
    AllRefused(Vec<String>),
    /// Interrupted by a signal.
    Interrupted,
}

pub fn refused(line: impl Display) -> End {
    End::Refused(line.to_string())
}

/// Refuses a reference, and says how one is made where that is the remedy.
pub fn unmade(error: ReferenceError) -> End {
    match error {
        ReferenceError::File { .. } | ReferenceError::Content { .. } => {
            refused(format!("{error}: make reference"))
        }
        other => refused(other),
    }
}

/// Refuses a file that an option asks for and that cannot be written.
pub fn unwritable(option: &str, path: &Path, error: &dyn Display) -> End {
    refused(format!(
        "{option} {}: cannot be written ({error}); name a file in an existing, writable folder",
        path.display()
    ))
}

/// Prints to stdout; a closed pipe is not an error.
pub fn print(text: &dyn Display) -> Result<(), End> {
    let mut stdout = std::io::stdout().lock();
    match write!(stdout, "{text}").and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(refused(format!(
            "stdout: cannot be written ({error}); connect it to a place with room"
        ))),
        _ => Ok(()),
    }
}
