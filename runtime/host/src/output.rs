//! Writes a file that a person named, in one way for all commands.
//!
//! - A regular file is written completely or not at all: a [`Draft`] is a temporary file beside it,
//!   which [`Draft::commit`] renames.
//! - A symbolic link is followed: its target is replaced, in the target's folder, and the link
//!   stays a link.
//! - A device, a FIFO or a socket is written into, not replaced.
//! - An output that is an input, or another output, is refused before any work: [`check`].
//!
//! What can fail: the path is a folder, its folder is missing or not writable, the file is
//! read-only, or there is no room; a failure leaves the previous file unchanged.

mod place;

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::Path;

use tempfile::NamedTempFile;

use place::{Place, Same};

/// Name of an option, and the file that it gives to a command.
pub type Named<'a> = (&'a str, &'a Path);

/// Reason why outputs cannot be written to the given paths.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OutputError {
    /// An output is also an input.
    #[error("{output}: it is what {input} reads; name another file")]
    Input {
        /// Output, with its option.
        output: String,
        /// Option of the input.
        input: String,
    },
    /// Two outputs are the same file.
    #[error("{output}: {other} writes the same file; name another")]
    Twice {
        /// Second output, with its option.
        output: String,
        /// First output, with its option.
        other: String,
    },
    /// An output cannot be written.
    #[error("{output}: cannot be written ({source}); name a file in an existing, writable folder")]
    Unwritable {
        /// Output, with its option.
        output: String,
        /// Error of the operating system.
        source: io::Error,
    },
}

/// Checks, before any work, that all outputs can be written and none is an input or another output.
///
/// Devices may be given more than once. An empty option name stands for a positional argument.
pub fn check(inputs: &[Named], outputs: &[Named]) -> Result<(), OutputError> {
    apart(inputs, outputs)?;
    for output in outputs {
        draft(output.1).map_err(|source| OutputError::Unwritable {
            output: said(output),
            source,
        })?;
    }
    Ok(())
}

/// Checks that all outputs differ from the inputs and from each other, without writing anything.
pub fn apart(inputs: &[Named], outputs: &[Named]) -> Result<(), OutputError> {
    let inputs: Vec<_> = inputs
        .iter()
        .map(|input| (input, Same::of(input.1)))
        .collect();
    let mut before: Vec<(&Named, Same)> = vec![];
    for output in outputs {
        let same = Same::of(output.1);
        if let Some((input, _)) = inputs.iter().find(|(_, input)| input.is(&same)) {
            return Err(OutputError::Input {
                output: said(output),
                input: option(input, "the command"),
            });
        }
        if let Some((other, _)) = before.iter().find(|(_, other)| other.is(&same)) {
            return Err(OutputError::Twice {
                output: said(output),
                other: option(other, "the command itself"),
            });
        }
        before.push((output, same));
    }
    Ok(())
}

/// Formats the option and its file.
fn said((option, path): &Named) -> String {
    let gap = if option.is_empty() { "" } else { " " };
    format!("{option}{gap}{}", path.display())
}

fn option((option, _): &Named, otherwise: &str) -> String {
    let named = if option.is_empty() { otherwise } else { option };
    named.to_owned()
}

/// A file that is being written: its path is untouched before [`commit`](Self::commit).
#[derive(Debug)]
pub struct Draft {
    file: NamedTempFile,
    place: Place,
}

/// Starts writing a file at `path`; also checks, before any work, that this is possible.
pub fn draft(path: &Path) -> io::Result<Draft> {
    let place = Place::of(path)?;
    let mut builder = tempfile::Builder::new();
    builder.prefix(".lads-").suffix(".tmp");
    let file = match &place {
        Place::Stream(_) => builder.tempfile()?,
        Place::File(path) => {
            // As `File::create` would: readable by all whom the umask lets.
            #[cfg(unix)]
            builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
            let file = builder.tempfile_in(place::folder(path))?;
            if let Ok(about) = fs::metadata(path) {
                // What may not be written is not replaced either, and what is replaced keeps its mode.
                OpenOptions::new().write(true).open(path)?;
                file.as_file().set_permissions(about.permissions())?;
            }
            file
        }
    };
    Ok(Draft { file, place })
}

/// Starts writing a file at `path`, in a folder that is made if it is missing.
pub fn draft_with_folder(path: &Path) -> io::Result<Draft> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder)?;
    }
    draft(path)
}

/// Writes `bytes` to `path`.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut draft = draft(path)?;
    draft.write_all(bytes)?;
    draft.commit()
}

impl Draft {
    /// Returns the temporary path of the file, for a program that writes it.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// Returns the open file.
    pub fn as_file_mut(&mut self) -> &mut File {
        self.file.as_file_mut()
    }

    /// Moves the complete file to its path.
    pub fn commit(self) -> io::Result<()> {
        match self.place {
            Place::File(path) => {
                self.file.as_file().sync_all()?;
                self.file.persist(&path).map_err(|error| error.error)?;
                Ok(())
            }
            Place::Stream(path) => {
                // Opened anew: another program may have written it.
                let mut written = File::open(self.file.path())?;
                // Appended: where it leads to a file of the shell's, that one has a beginning already.
                let mut stream = OpenOptions::new().append(true).open(path)?;
                io::copy(&mut written, &mut stream)?;
                stream.flush()
            }
        }
    }
}

impl Write for Draft {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Read for Draft {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        self.file.read(bytes)
    }
}

impl Seek for Draft {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}

#[cfg(all(test, unix))]
mod tests;
