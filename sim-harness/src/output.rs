//! Files that are there whole or not at all: written to a temporary file beside the target, which is renamed when it is complete.
//!
//! Invariant: a failure, or an interrupt, leaves the target as it was.

use std::io::{self, Write as _};
use std::path::Path;

use serde::Serialize;

/// Writes `value` to `path` as JSON: to a temporary file in the same folder, then renamed.
pub fn write_json(value: &impl Serialize, path: &Path) -> io::Result<()> {
    let mut text = serde_json::to_vec_pretty(value)?;
    text.push(b'\n');
    write(&text, path)
}

/// Writes `bytes` to `path`: to a temporary file in the same folder, then renamed.
pub fn write(bytes: &[u8], path: &Path) -> io::Result<()> {
    let mut file = temporary_beside(path)?;
    file.write_all(bytes)?;
    file.as_file().sync_all()?;
    file.persist(path).map_err(|error| error.error)?;
    Ok(())
}

/// A temporary file in the folder of `path`, so that it can be renamed to it; also the check, made before any rollout, that this will work.
pub fn temporary_beside(path: &Path) -> io::Result<tempfile::NamedTempFile> {
    if path.is_dir() {
        return Err(io::Error::new(
            io::ErrorKind::IsADirectory,
            "it is a folder",
        ));
    }
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let mut builder = tempfile::Builder::new();
    builder.prefix(".lads-").suffix(".tmp");
    // As `File::create` would: readable by all whom the umask lets.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder)
}

/// The same, in a folder that is made where it is missing.
pub fn temporary_with_folder(path: &Path) -> io::Result<tempfile::NamedTempFile> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    temporary_beside(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_the_old_file() {
        let folder = tempfile::tempdir().unwrap();
        assert!(
            temporary_beside(folder.path()).is_err(),
            "a folder is no target"
        );
        assert!(temporary_beside(&folder.path().join("no/such/r.json")).is_err());
        let target = folder.path().join("r.json");
        std::fs::write(&target, "old").unwrap();
        drop(temporary_beside(&target).unwrap());
        assert_eq!(std::fs::read_to_string(&target).unwrap(), "old");
        assert_eq!(
            std::fs::read_dir(folder.path()).unwrap().count(),
            1,
            "no temporary file stays"
        );
    }

    #[test]
    fn a_write_replaces_the_file_as_a_whole() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("r.json");
        std::fs::write(&target, "something much longer than what comes").unwrap();
        write_json(&[1, 2], &target).unwrap();
        let read: Vec<u32> =
            serde_json::from_str(&std::fs::read_to_string(&target).unwrap()).unwrap();
        assert_eq!(read, [1, 2]);
        assert_eq!(
            std::fs::read_dir(folder.path()).unwrap().count(),
            1,
            "no temporary file stays"
        );
    }
}
