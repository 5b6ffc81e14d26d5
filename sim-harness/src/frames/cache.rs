//! The frames of a dataset's states, in a safetensors file beside it: a cache, which the dataset makes again.
//!
//! One tensor, `frames` (u8 \[T, rows, columns, 3\]), a frame for each of the dataset's T rows; the metadata name the dataset by its sha256 and
//! hold the [`Rendering`] as JSON. The file grows in order as `FILE.part` and gets its name when it is whole, so work that was stopped goes
//! on where it stood. What can fail: no dataset, one whose states the scene does not have, a `FILE.part` of something else, no room, no EGL.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, Read as _, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::thread;

use safetensors::{Dtype, SafeTensors};
use serde_json::json;
use thiserror::Error;

use super::{Frames, Rendering};
use crate::environment::Environment;
use crate::film::FilmError;
use crate::queue::Queue;

/// `format` of the metadata.
pub const FORMAT: &str = "lads-frames";
/// Frames that a thread draws at a time.
const CHUNK: usize = 50;

/// Reason why a cache of frames cannot be made.
#[derive(Debug, Error)]
pub enum CacheError {
    /// The dataset cannot be used.
    #[error("{}: {reason}; make one with lads-collect", .path.display())]
    Dataset {
        /// Path of the file.
        path: PathBuf,
        /// Problem of the dataset.
        reason: String,
    },
    /// The file was begun for another dataset or rendering.
    #[error("{}: it was begun for another dataset or rendering; remove it, or write to another file", .0.display())]
    Other(PathBuf),
    /// The file system refuses.
    #[error("{}: {source}; name a file in an existing, writable folder with room", .path.display())]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A frame cannot be drawn.
    #[error(transparent)]
    Film(#[from] FilmError),
}

/// States of a dataset, with the dataset's environment and digest.
#[derive(Debug, Clone, PartialEq)]
pub struct States {
    /// Name of the dataset's environment.
    pub environment: String,
    /// SHA-256 of the dataset's file.
    pub sha256: String,
    /// Number of elements of a state.
    width: usize,
    values: Vec<f32>,
}

impl States {
    /// Reads the states of a dataset of any environment: `states`, or `observations` where there is no noise.
    pub fn read(path: &Path) -> Result<Self, CacheError> {
        let refused = |reason: String| CacheError::Dataset {
            path: path.to_path_buf(),
            reason,
        };
        let bytes = lads_host::input::read(path).map_err(|error| refused(error.to_string()))?;
        Self::from_bytes(&bytes).map_err(refused)
    }

    fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        let (_, header) = SafeTensors::read_metadata(bytes)
            .map_err(|error| format!("no safetensors file ({error})"))?;
        let metadata = header.metadata().clone().unwrap_or_default();
        if metadata.get("format").map(String::as_str) != Some(crate::dataset::FORMAT) {
            return Err(format!("its format is not \"{}\"", crate::dataset::FORMAT));
        }
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
        let states = tensors.tensor("states");
        let states = states.or_else(|_| tensors.tensor("observations"));
        let states = states.map_err(|_| "it has no states".to_owned())?;
        let (Dtype::F32, &[_, width]) = (states.dtype(), states.shape()) else {
            return Err("its states are no rows of f32".to_owned());
        };
        let values = states.data().as_chunks().0.iter();
        Ok(Self {
            environment: metadata.get("environment").cloned().unwrap_or_default(),
            sha256: lads_compiler::sha256(bytes),
            width: width.max(1),
            values: values.map(|&bytes| f32::from_le_bytes(bytes)).collect(),
        })
    }

    /// Returns the number of states.
    pub fn len(&self) -> usize {
        self.values.len() / self.width
    }

    /// Returns whether there are no states.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    fn draw(
        &self,
        rows: std::ops::Range<usize>,
        frames: &mut Frames,
    ) -> Result<Vec<u8>, FilmError> {
        let mut drawn = Vec::new();
        for state in self
            .values
            .chunks_exact(self.width)
            .skip(rows.start)
            .take(rows.len())
        {
            let positions: Vec<f64> = state.iter().map(|&value| f64::from(value)).collect();
            drawn.extend_from_slice(frames.draw(&positions)?);
        }
        Ok(drawn)
    }
}

/// Number of frames that are done, and of all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// Frames that are in the file.
    pub done: usize,
    /// Frames of the whole.
    pub all: usize,
}

/// Makes the cache of frames at `path`, or continues it, until `stop` is raised. `progress` is called with the frames that are in the file.
pub fn make(
    (states, rendering): (&States, &Rendering),
    path: &Path,
    (open, threads): (&(dyn Fn() -> Box<dyn Environment> + Sync), usize),
    stop: &AtomicBool,
    progress: &mut dyn FnMut(usize),
) -> Result<Progress, CacheError> {
    let head = head(states, rendering);
    let all = states.len();
    let part = PathBuf::from(format!("{}.part", path.display()));
    // It is replaced by the finished file: a link would be lost, and a device or FIFO has no beginning to read.
    if std::fs::symlink_metadata(path).is_ok_and(|found| !found.is_file()) {
        let kind = io::Error::new(io::ErrorKind::InvalidInput, "it is no regular file");
        return Err(io_error(path)(kind));
    }
    if path.exists() {
        let begun = begins_with(path, &head).map_err(io_error(path))?;
        let found = std::fs::metadata(path).map_err(io_error(path))?.len();
        let wanted = head.len() + all * rendering.frame_len();
        let whole = (begun && found == wanted as u64).then_some(Progress { done: all, all });
        return whole.ok_or_else(|| CacheError::Other(path.to_path_buf()));
    }
    let (mut file, mut done) = resume(&part, &head, rendering.frame_len(), all)?;
    progress(done);
    // A chunk that never comes, because a thread panicked, would let the later ones pile up.
    let queue = Queue::new(done..all);
    thread::scope(|scope| {
        let (sender, receiver) = mpsc::sync_channel(2 * threads.max(1));
        for _ in 0..threads.max(1) {
            let (sender, queue) = (sender.clone(), &queue);
            scope.spawn(move || {
                let _halts = queue.halts_on_panic();
                let mut frames = match Frames::new(open().as_ref(), rendering) {
                    Ok(frames) => frames,
                    Err(error) => {
                        // Nobody listens any more where another thread has failed too.
                        let _ = sender.send((done, Err(error)));
                        return;
                    }
                };
                while let Some(rows) = queue.take(CHUNK) {
                    if stop.load(Ordering::Relaxed) {
                        return;
                    }
                    let first = rows.start;
                    let drawn = states.draw(rows, &mut frames);
                    let failed = drawn.is_err();
                    if sender.send((first, drawn)).is_err() || failed {
                        return;
                    }
                }
            });
        }
        drop(sender);
        let mut early = BTreeMap::new();
        let outcome: Result<(), CacheError> = receiver.iter().try_for_each(|(first, drawn)| {
            early.insert(first, drawn?);
            while let Some(bytes) = early.remove(&done) {
                file.write_all(&bytes).map_err(io_error(&part))?;
                done += bytes.len() / rendering.frame_len();
                progress(done);
            }
            Ok(())
        });
        queue.halt();
        // Who waits to send may go.
        drop(receiver);
        outcome
    })?;
    file.sync_all().map_err(io_error(&part))?;
    if done == all {
        std::fs::rename(&part, path).map_err(io_error(path))?;
    }
    Ok(Progress { done, all })
}

fn io_error(path: &Path) -> impl Fn(io::Error) -> CacheError {
    let path = path.to_path_buf();
    move |source| CacheError::Io {
        path: path.clone(),
        source,
    }
}

/// Everything before the first frame: the header's length, and the header in JSON, padded to a multiple of eight bytes.
fn head(states: &States, rendering: &Rendering) -> Vec<u8> {
    let [rows, columns] = rendering.size;
    let bytes = states.len() * rendering.frame_len();
    let header = json!({
        "__metadata__": {
            "format": FORMAT,
            "version": "1",
            "environment": states.environment,
            "dataset_sha256": states.sha256,
            "rendering": json!(rendering).to_string(),
        },
        "frames": {
            "dtype": "U8",
            "shape": [states.len(), rows, columns, 3],
            "data_offsets": [0, bytes],
        },
    });
    let mut text = header.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(8), b' ');
    let mut head = (text.len() as u64).to_le_bytes().to_vec();
    head.extend(text);
    head
}

fn begins_with(path: &Path, head: &[u8]) -> io::Result<bool> {
    let mut begin = Vec::new();
    File::open(path)?
        .take(head.len() as u64)
        .read_to_end(&mut begin)?;
    Ok(begin == head)
}

/// Opens an unfinished file behind its last whole frame, of `all` at most, and returns the number of frames in it; or begins the file.
fn resume(
    part: &Path,
    head: &[u8],
    frame_len: usize,
    all: usize,
) -> Result<(File, usize), CacheError> {
    let refused = io_error(part);
    let begun = std::fs::metadata(part).map_or(0, |found| found.len() as usize);
    let (own, _) = head.split_at(begun.min(head.len()));
    if begun > 0 && !begins_with(part, own).map_err(&refused)? {
        return Err(CacheError::Other(part.to_path_buf()));
    }
    let mut file = OpenOptions::new()
        .write(true)
        .create(true)
        .truncate(false)
        .open(part)
        .map_err(&refused)?;
    let done = (begun.saturating_sub(head.len()) / frame_len).min(all);
    if begun < head.len() {
        file.set_len(0).map_err(&refused)?;
        file.write_all(head).map_err(&refused)?;
    } else {
        let end = (head.len() + done * frame_len) as u64;
        file.set_len(end).map_err(&refused)?;
        file.seek(SeekFrom::Start(end)).map_err(&refused)?;
    }
    Ok((file, done))
}
