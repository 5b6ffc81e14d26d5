//! Writes pictures to an animated GIF, an MP4, or a folder of PNG; complete or not at all.
//!
//! Everything goes to a temporary place beside the target, which is renamed when it is complete. What can fail: the file's name, an existing
//! folder with something in it, no ffmpeg, no room.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use super::FilmError;
use super::canvas::Canvas;
use super::gif::Gif;
use super::mp4::{self, Mp4};
use crate::output::{self, Draft};

/// Shortest time that a picture is shown, in seconds: browsers do not show GIFs faster, and eyes see nothing.
pub const SHORTEST_S: f64 = 0.05;
/// Time that the last picture stays, in seconds.
const LAST_S: f64 = 2.0;

/// Output format of pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// Animated GIF.
    Gif,
    /// MP4, compressed by ffmpeg.
    Mp4,
    /// Folder of PNG files.
    Folder,
}

/// Why pictures cannot be written to a path.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    /// The path's name implies no format.
    #[error(
        "its name ends neither in .gif nor in .mp4 nor in a slash; end it in a slash for a folder of PNG"
    )]
    Form,
    /// The folder is not empty.
    #[error("the folder is not empty; name a new one")]
    NotEmpty,
    /// ffmpeg cannot be run.
    #[error(
        "an MP4 needs the program ffmpeg, which cannot be run ({0}); install it (Debian: apt-get install ffmpeg), or record a .gif"
    )]
    NoFfmpeg(io::Error),
    /// The path cannot be written to.
    #[error("cannot be written ({0}); name a file in an existing, writable folder")]
    Unwritable(io::Error),
}

impl Form {
    /// Finds the format that a path asks for, if pictures can be written there.
    pub fn of(path: &Path) -> Result<Self, PlaceError> {
        let slash = path.as_os_str().as_encoded_bytes().ends_with(b"/");
        let form = match path.extension().and_then(|ending| ending.to_str()) {
            _ if slash || path.is_dir() => Self::Folder,
            Some("gif") => Self::Gif,
            Some("mp4") => Self::Mp4,
            _ => return Err(PlaceError::Form),
        };
        if form == Self::Folder {
            temporary_folder(path).map_err(PlaceError::Unwritable)?;
            // A folder that is missing is made.
            let first = fs::read_dir(path)
                .ok()
                .and_then(|mut entries| entries.next());
            return first.map_or(Ok(form), |_| Err(PlaceError::NotEmpty));
        }
        output::draft(path).map_err(PlaceError::Unwritable)?;
        if form == Self::Mp4 {
            mp4::check().map_err(PlaceError::NoFfmpeg)?;
        }
        Ok(form)
    }
}

/// Resolves a symbolic link to the folder behind it, where there is one.
fn behind_link(path: &Path) -> PathBuf {
    fs::canonicalize(path).unwrap_or_else(|_| path.to_owned())
}

fn temporary_folder(path: &Path) -> io::Result<TempDir> {
    let path = &behind_link(path);
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let mut builder = tempfile::Builder::new();
    builder.prefix(".lads-").suffix(".tmp");
    // As `create_dir` would: open to all whom the umask lets.
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o777));
    builder.tempdir_in(folder)
}

/// Writes pictures, all of one size.
pub struct Sink {
    kind: Kind,
    /// Time that each picture is shown, in seconds.
    shown_s: f64,
}

enum Kind {
    Gif(Box<Gif>),
    Mp4(Mp4),
    Folder { folder: TempDir, count: usize },
}

/// Complete pictures that are still at a temporary path.
pub enum Finished {
    /// A single file.
    File(Draft),
    /// A folder of files.
    Folder(TempDir),
}

impl Sink {
    /// Opens a temporary file or folder beside `path`. Pictures follow each other after `period_s`, or slower: see [`SHORTEST_S`].
    pub fn new(form: Form, path: &Path, size: [u32; 2], period_s: f64) -> Result<Self, FilmError> {
        let shown_s = shown_s(period_s);
        let kind = match form {
            Form::Gif => Kind::Gif(Box::new(Gif::new(path)?)),
            Form::Mp4 => Kind::Mp4(Mp4::new(path, size, shown_s)?),
            Form::Folder => Kind::Folder {
                folder: temporary_folder(path)?,
                count: 0,
            },
        };
        Ok(Self { kind, shown_s })
    }

    /// Whether sample pictures should come first, see [`learn`](Self::learn).
    pub fn learns(&self) -> bool {
        matches!(self.kind, Kind::Gif(_))
    }

    /// Adds the colours of a sample picture to the palette to come.
    pub fn learn(&mut self, canvas: &Canvas) {
        if let Kind::Gif(gif) = &mut self.kind {
            gif.learn(canvas);
        }
    }

    /// Adds a picture; `last` gives it the display time of a last picture.
    pub fn add(&mut self, canvas: &Canvas, last: bool) -> Result<(), FilmError> {
        let seconds = if last { LAST_S } else { self.shown_s };
        match &mut self.kind {
            Kind::Gif(gif) => gif.add(canvas, seconds),
            Kind::Mp4(mp4) => {
                let times = (seconds / self.shown_s).round() as usize;
                (0..times.max(1)).try_for_each(|_| mp4.add(canvas))
            }
            Kind::Folder { folder, count } => {
                let path = folder.path().join(format!("{count:04}.png"));
                *count += 1;
                Ok(fs::write(path, png(canvas)?)?)
            }
        }
    }

    /// Completes the output.
    pub fn finish(self) -> Result<Finished, FilmError> {
        match self.kind {
            Kind::Gif(gif) => gif.finish().map(Finished::File),
            Kind::Mp4(mp4) => mp4.finish().map(Finished::File),
            Kind::Folder { folder, .. } => Ok(Finished::Folder(folder)),
        }
    }
}

impl Finished {
    /// Moves the complete output to `path`.
    pub fn persist(self, path: &Path) -> Result<(), FilmError> {
        match self {
            Self::File(file) => {
                file.commit()?;
            }
            Self::Folder(folder) => {
                fs::rename(folder.path(), behind_link(path))?;
                let _: PathBuf = folder.keep();
            }
        }
        Ok(())
    }
}

/// Time that a picture is shown if control steps take `period_s`.
pub fn shown_s(period_s: f64) -> f64 {
    period_s.max(SHORTEST_S)
}

/// Encodes a picture as PNG.
pub fn png(canvas: &Canvas) -> Result<Vec<u8>, FilmError> {
    let [width, height] = canvas.size();
    let file = crate::frames::png::encode(canvas.rgb(), [height, width]);
    file.map_err(FilmError::Draw)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Makes a picture in two colours, which part at column `at`.
    fn picture(at: usize) -> Canvas {
        let mut canvas = Canvas::new(8, 6);
        let ink = super::super::caption::colors().nth(3).unwrap();
        let row = |column| if column < at { [200, 30, 30] } else { ink };
        let pixels: Vec<u8> = (0..6).flat_map(|_| (0..8).flat_map(row)).collect();
        canvas.paste(&pixels, 8, 0, 0);
        canvas
    }

    fn film(form: Form, path: &Path) -> Result<Finished, FilmError> {
        let mut sink = Sink::new(form, path, [8, 6], 0.08)?;
        sink.add(&picture(2), false)?;
        sink.add(&picture(5), true)?;
        sink.finish()
    }

    #[test]
    fn a_gif_reads_back_as_it_was_drawn() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.gif");
        film(Form::Gif, &path).unwrap().persist(&path).unwrap();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut decoder = options.read_info(fs::File::open(&path).unwrap()).unwrap();
        let mut shown = [0; 4 * 8 * 6];
        for (at, delay) in [(2, 8), (5, 200)] {
            let frame = decoder.read_next_frame().unwrap().unwrap();
            assert_eq!(frame.delay, delay);
            for (shown, new) in shown.chunks_mut(4).zip(frame.buffer.chunks(4)) {
                if new[3] > 0 {
                    shown.copy_from_slice(new);
                }
            }
            let drawn = picture(at);
            for (shown, drawn) in shown.chunks(4).zip(drawn.rgb().chunks(3)) {
                let apart = shown.iter().zip(drawn).map(|(&a, &b)| a.abs_diff(b)).max();
                assert!(apart.unwrap() <= 8, "{shown:?} {drawn:?}");
            }
        }
        assert!(decoder.read_next_frame().unwrap().is_none());
    }

    #[test]
    fn a_folder_has_a_picture_for_every_state() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pictures/");
        assert_eq!(Form::of(&path).unwrap(), Form::Folder);
        film(Form::Folder, &path).unwrap().persist(&path).unwrap();
        let decoder = png::Decoder::new(io::BufReader::new(
            fs::File::open(path.join("0001.png")).unwrap(),
        ));
        let mut reader = decoder.read_info().unwrap();
        let mut read = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut read).unwrap();
        assert_eq!(read, picture(5).rgb());
        assert!(matches!(Form::of(&path), Err(PlaceError::NotEmpty)));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn what_is_not_finished_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        for form in [Form::Gif, Form::Folder] {
            drop(film(form, &folder.path().join("a")).unwrap());
            assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
        }
        assert!(matches!(
            Form::of(Path::new("a.avi")),
            Err(PlaceError::Form)
        ));
        let nowhere = folder.path().join("no/such/a.gif");
        assert!(matches!(Form::of(&nowhere), Err(PlaceError::Unwritable(_))));
    }
}
