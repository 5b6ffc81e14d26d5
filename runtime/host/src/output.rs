//! Writing a file that a person named, in one way for all commands.
//!
//! - A regular file is there whole or not at all: a [`Draft`] is a temporary file beside it, which [`Draft::commit`] renames.
//! - A symbolic link is followed: what it leads to is replaced, in its own folder, and the link stays a link.
//! - A device, a FIFO or a socket is written into, and stays what it is.
//! - An output that is an input, or another output, is refused before any work: [`check`].
//!
//! What can fail: the place is a folder, its folder is missing or not writable, the file is read-only, or there is no room; a failure
//! leaves what was there.

mod place;

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::Path;

use tempfile::NamedTempFile;

use place::{Place, Same};

/// A file that a command was told to use, and by which option.
pub type Named<'a> = (&'a str, &'a Path);

/// Why outputs cannot be written where they were asked for.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OutputError {
    /// One of them is what is read.
    #[error("{output}: it is what {input} reads; name another file")]
    Input {
        /// The output, with its option.
        output: String,
        /// The option of the input.
        input: String,
    },
    /// Two of them are one file.
    #[error("{output}: {other} writes the same file; name another")]
    Twice {
        /// The second one, with its option.
        output: String,
        /// The option of the first one.
        other: String,
    },
    /// One of them cannot be written.
    #[error("{output}: cannot be written ({source}); name a file in an existing, writable folder")]
    Unwritable {
        /// The output, with its option.
        output: String,
        /// What the system says.
        source: io::Error,
    },
}

/// Looks, before any work, whether all outputs can be written and none is an input or another output.
///
/// Devices may stand in more than one place. An empty option names an argument without one.
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

/// The part of [`check`] that writes nothing: whether all outputs differ from the inputs and from each other.
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

/// The option and its file.
fn said((option, path): &Named) -> String {
    let gap = if option.is_empty() { "" } else { " " };
    format!("{option}{gap}{}", path.display())
}

fn option((option, _): &Named, otherwise: &str) -> String {
    let named = if option.is_empty() { otherwise } else { option };
    named.to_owned()
}

/// A file on its way: nothing is at its place before [`commit`](Self::commit).
#[derive(Debug)]
pub struct Draft {
    file: NamedTempFile,
    place: Place,
}

/// Begins a file at `path`; also the check, made before any work, that this works.
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

/// The same, in a folder that is made where it is missing.
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
    /// Where it lies now, for a program that writes it.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// The file.
    pub fn as_file_mut(&mut self) -> &mut File {
        self.file.as_file_mut()
    }

    /// Puts it in its place, complete.
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
