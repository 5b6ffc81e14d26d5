//! Resolves paths, and tells whether two lead to the same file.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Largest number of symbolic links that are followed, as in the Linux kernel.
const MOST_LINKS: usize = 40;

/// Folders of the system's own links, whose targets have no folder to rename in: `/dev/stdout`,
/// `/proc/self/fd/1`.
const SYSTEM: [&str; 2] = ["/dev", "/proc"];

/// Target of a path.
#[derive(Debug, PartialEq, Eq)]
pub enum Place {
    /// A regular file, existing or not, with all links resolved.
    File(PathBuf),
    /// A device, FIFO or socket that is written into.
    Stream(PathBuf),
}

impl Place {
    /// Resolves `path`; a folder is an error.
    pub fn of(path: &Path) -> io::Result<Self> {
        match fs::metadata(path) {
            Ok(about) if about.is_dir() => Err(io::Error::new(
                io::ErrorKind::IsADirectory,
                "it is a folder",
            )),
            Ok(about) if !about.is_file() || of_system(path) => Ok(Self::Stream(path.to_owned())),
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => behind_links(path).map(Self::File),
        }
    }
}

fn of_system(path: &Path) -> bool {
    SYSTEM.iter().any(|folder| path.starts_with(folder)) && !path.starts_with("/dev/shm")
}

/// Returns the folder of a file.
pub fn folder(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// Resolves all symbolic links of the path's last part, also if the file does not exist yet.
fn behind_links(path: &Path) -> io::Result<PathBuf> {
    let mut path = path.to_owned();
    for _ in 0..MOST_LINKS {
        match fs::symlink_metadata(&path) {
            Ok(about) if about.is_symlink() => path = folder(&path).join(fs::read_link(&path)?),
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => return Ok(path),
        }
    }
    Err(io::Error::other("too many symbolic links"))
}

/// Identity by which two paths are compared.
#[derive(Debug)]
pub enum Same {
    /// An existing file: device and inode.
    #[cfg(unix)]
    There(u64, u64),
    /// A file that does not exist yet, or a system without inodes: the folder, links resolved, and
    /// the name.
    Named(PathBuf),
    /// A device, which may be shared by all.
    Shared,
}

impl Same {
    pub fn of(path: &Path) -> Self {
        let about = fs::metadata(path).ok();
        #[cfg(unix)]
        if let Some(about) = &about {
            use std::os::unix::fs::{FileTypeExt as _, MetadataExt as _};

            let kind = about.file_type();
            if kind.is_char_device() || kind.is_block_device() || kind.is_socket() {
                return Self::Shared;
            }
            return Self::There(about.dev(), about.ino());
        }
        if about.is_some() {
            return Self::Named(fs::canonicalize(path).unwrap_or_else(|_| path.to_owned()));
        }
        let end = behind_links(path).unwrap_or_else(|_| path.to_owned());
        let named = fs::canonicalize(folder(&end));
        Self::Named(match (named, end.file_name()) {
            (Ok(folder), Some(name)) => folder.join(name),
            _ => end,
        })
    }

    pub fn is(&self, other: &Self) -> bool {
        match (self, other) {
            #[cfg(unix)]
            (Self::There(device, inode), Self::There(other_device, other_inode)) => {
                device == other_device && inode == other_inode
            }
            (Self::Named(path), Self::Named(other)) => path == other,
            _ => false,
        }
    }
}
