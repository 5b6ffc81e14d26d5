//! Writes an MP4 with the program `ffmpeg`: no encoder in pure Rust makes a format that every player and browser shows. What can fail: no
//! ffmpeg, one that cannot make it, no room.

use std::io::{self, Write as _};
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use super::FilmError;
use super::canvas::Canvas;
use crate::output::{self, Draft};

const FFMPEG: &str = "ffmpeg";

/// Whether ffmpeg can be run.
pub(super) fn check() -> io::Result<()> {
    let mut command = Command::new(FFMPEG);
    command.arg("-version").stdin(Stdio::null());
    command
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()?;
    Ok(())
}

/// An MP4 that is being written through ffmpeg.
pub(super) struct Mp4 {
    ffmpeg: Ffmpeg,
    file: Draft,
}

/// The running program, which is killed when this is dropped.
struct Ffmpeg(Child);

impl Drop for Ffmpeg {
    fn drop(&mut self) {
        // One that has ended cannot be ended again.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Mp4 {
    pub(super) fn new(
        path: &Path,
        [width, height]: [u32; 2],
        shown_s: f64,
    ) -> Result<Self, FilmError> {
        let file = output::draft(path)?;
        let (rate, size) = (format!("{}", 1.0 / shown_s), format!("{width}x{height}"));
        // Without the protocol's name, a colon in a path would be taken for one.
        let mut output = std::ffi::OsString::from("file:");
        output.push(file.path());
        let child = Command::new(FFMPEG)
            .args([
                "-loglevel",
                "error",
                "-y",
                "-f",
                "rawvideo",
                "-pix_fmt",
                "rgb24",
            ])
            .args(["-framerate", &rate, "-video_size", &size, "-i", "-"])
            // What every player and browser shows, and begins to show before all is there.
            .args([
                "-pix_fmt",
                "yuv420p",
                "-movflags",
                "+faststart",
                "-f",
                "mp4",
            ])
            .arg(output)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            // An interrupt of ours is not its.
            .process_group(0)
            .spawn()?;
        Ok(Self {
            ffmpeg: Ffmpeg(child),
            file,
        })
    }

    pub(super) fn add(&mut self, canvas: &Canvas) -> Result<(), FilmError> {
        let written = match &mut self.ffmpeg.0.stdin {
            Some(stdin) => stdin.write_all(canvas.rgb()),
            None => Err(io::ErrorKind::BrokenPipe.into()),
        };
        written.map_err(|error| match error.kind() {
            // It left early, and says why at the end.
            io::ErrorKind::BrokenPipe => FilmError::Ffmpeg(self.said()),
            _ => FilmError::Write(error),
        })
    }

    /// Closes the program's input and returns the last line that it printed.
    fn said(&mut self) -> String {
        drop(self.ffmpeg.0.stdin.take());
        let text = self.ffmpeg.0.stderr.take().map(io::read_to_string);
        let text = text.and_then(Result::ok).unwrap_or_default();
        text.lines().last().unwrap_or("it ended early").to_owned()
    }

    pub(super) fn finish(mut self) -> Result<Draft, FilmError> {
        let said = self.said();
        if !self.ffmpeg.0.wait()?.success() {
            return Err(FilmError::Ffmpeg(said));
        }
        Ok(self.file)
    }
}
