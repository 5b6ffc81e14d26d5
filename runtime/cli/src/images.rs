//! `lads act --images`: where camera frames come from.
//!
//! PNG files of a folder in the order of their names, one for each control step; or the bytes of frames as they are, one behind the other, on
//! stdin. A frame has just the rows, columns and bytes per pixel of its channel. What can fail: no such folder or channel, a file that is
//! no such picture, half a frame at the end.

use std::io::{BufReader, ErrorKind, Read};
use std::path::{Path, PathBuf};

use lads_core::{Channel, ChannelId, Contract, DType};

use crate::refusal::Refusal;
use crate::seen::Seen;

const OPTION: &str = "--images";
/// Instead of a folder: stdin.
const RAW: &str = "raw";

/// Where all frames of a policy come from.
pub enum Images {
    /// One frame for each camera and step, in folders.
    Folders(Vec<Folder>),
    /// Bytes on stdin, the channels' one behind the other in every step.
    Raw(Vec<ChannelId>),
}

/// The frames of a camera as files.
pub struct Folder {
    channel: ChannelId,
    /// Rows, columns, bytes per pixel.
    shape: [usize; 3],
    path: PathBuf,
    files: Vec<PathBuf>,
}

impl Images {
    /// What was asked for: `raw`, a folder for the only camera, or `CHANNEL=FOLDER` for each.
    pub fn of(asked: &[String], contract: &Contract<'_>) -> Result<Option<Self>, Refusal> {
        if asked.is_empty() {
            return Ok(None);
        }
        let cameras: Vec<Channel<'_>> = contract
            .observations()
            .filter(|channel| shape(channel).is_some())
            .collect();
        if cameras.is_empty() {
            let wrong = "no channel of the policy takes images of bytes";
            return Err(Refusal::new(OPTION, wrong, "leave it out"));
        }
        if asked.iter().any(|asked| asked == RAW) {
            let others = contract.observations().count() - cameras.len();
            if asked.len() > 1 || others > 0 {
                let wrong = "frames on stdin leave no place for other observations";
                return Err(Refusal::new(
                    format_args!("{OPTION} {RAW}"),
                    wrong,
                    "name a folder for each camera instead",
                ));
            }
            return Ok(Some(Self::Raw(cameras.iter().map(Channel::id).collect())));
        }
        let folders = asked.iter().map(|asked| folder(asked, &cameras));
        let folders = folders.collect::<Result<Vec<_>, _>>()?;
        let missing = cameras.iter().find(|camera| {
            let of_it = folders.iter().filter(|it| it.channel == camera.id());
            of_it.count() != 1
        });
        if let Some(camera) = missing {
            let wrong = format!("channel `{}` needs one folder of frames", camera.name());
            let remedy = format!("give {OPTION} {}=FOLDER once", camera.name());
            return Err(Refusal::new(OPTION, wrong, remedy));
        }
        let counts = |of: fn(usize, usize) -> usize| {
            let counts = folders.iter().map(|folder| folder.files.len());
            counts.reduce(of).unwrap_or_default()
        };
        let (fewest, most) = (counts(usize::min), counts(usize::max));
        if fewest != most {
            // A frame that is missing would pair all later ones with other moments.
            let wrong = format!("the folders have {fewest} to {most} frames");
            let remedy = "give one frame of each camera for every step";
            return Err(Refusal::new(OPTION, wrong, remedy));
        }
        Ok(Some(Self::Folders(folders)))
    }

    /// The files that frames are read from.
    pub fn files(&self) -> impl Iterator<Item = &Path> {
        let folders = match self {
            Self::Folders(folders) => &folders[..],
            Self::Raw(_) => &[],
        };
        folders
            .iter()
            .flat_map(|folder| folder.files.iter().map(PathBuf::as_path))
    }

    /// The channels that get their values from here.
    pub fn channels(&self) -> Vec<ChannelId> {
        match self {
            Self::Folders(folders) => folders.iter().map(|folder| folder.channel).collect(),
            Self::Raw(channels) => channels.clone(),
        }
    }

    /// Puts the frames of a step (from 0) where the policy sees them; `false` where there are no more.
    pub fn show(
        &self,
        step: usize,
        stdin: &mut impl Read,
        seen: &mut Seen,
    ) -> Result<bool, Refusal> {
        match self {
            Self::Folders(folders) => {
                for folder in folders {
                    let Some(file) = folder.files.get(step) else {
                        return Ok(false);
                    };
                    folder.read(file, seen.bytes(folder.channel))?;
                }
            }
            Self::Raw(channels) => {
                for (place, &channel) in channels.iter().enumerate() {
                    let bytes = seen.bytes(channel);
                    let got = fill(stdin, bytes).map_err(|error| {
                        Refusal::new("stdin", error, "connect it to what sends frames")
                    })?;
                    if got == 0 && place == 0 {
                        return Ok(false);
                    }
                    if got < bytes.len() {
                        let wrong =
                            format!("frame {} has {got} of {} bytes", step + 1, bytes.len());
                        let remedy =
                            "send whole frames: rows from the top, the bytes of each pixel";
                        return Err(Refusal::new("stdin", wrong, remedy));
                    }
                }
            }
        }
        Ok(true)
    }

    /// What is said where there are more other observations than frames.
    pub fn exhausted(&self) -> Refusal {
        let of = |folder: &Folder| (folder.files.len(), folder.path.clone());
        let (count, path) = match self {
            Self::Folders(folders) => folders.iter().map(of).min().unwrap_or_default(),
            Self::Raw(_) => (0, PathBuf::from("stdin")),
        };
        let wrong = format!("it has {count} frames, there are more observations");
        Refusal::new(path.display(), wrong, "give as many frames as lines")
    }
}

/// Reads until `bytes` is full or nothing comes any more; how many came.
fn fill(input: &mut impl Read, bytes: &mut [u8]) -> std::io::Result<usize> {
    let mut got = 0;
    while got < bytes.len() {
        match input.read(&mut bytes[got..]) {
            Ok(0) => break,
            Ok(more) => got += more,
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(got)
}

/// Rows, columns and bytes per pixel of a camera's channel.
fn shape(channel: &Channel<'_>) -> Option<[usize; 3]> {
    match (channel.dtype(), channel.shape()) {
        (DType::U8, &[rows, columns, bytes]) => Some([rows, columns, bytes].map(|n| n as usize)),
        _ => None,
    }
}

fn folder(asked: &str, cameras: &[Channel<'_>]) -> Result<Folder, Refusal> {
    let named = asked.split_once('=').and_then(|(name, path)| {
        let camera = cameras.iter().find(|camera| camera.name() == name)?;
        Some((camera, path))
    });
    let (camera, path) = match (named, cameras) {
        (Some(named), _) => named,
        (None, [only]) => (only, asked),
        (None, _) => {
            let names: Vec<_> = cameras.iter().map(Channel::name).collect();
            let wrong = "the policy has several cameras";
            let remedy = format!("give CHANNEL=FOLDER for each of {}", names.join(", "));
            return Err(Refusal::new(
                format_args!("{OPTION} {asked}"),
                wrong,
                remedy,
            ));
        }
    };
    let path = PathBuf::from(path);
    let files = pictures(&path).map_err(|error| {
        let thing = format!("{OPTION} {}", path.display());
        Refusal::new(thing, error, "name a folder of PNG files")
    })?;
    if files.is_empty() {
        let thing = format!("{OPTION} {}", path.display());
        let wrong = "no file in it ends in .png";
        return Err(Refusal::new(thing, wrong, "name a folder of PNG files"));
    }
    Ok(Folder {
        channel: camera.id(),
        shape: shape(camera).unwrap_or_default(),
        path,
        files,
    })
}

/// The PNG files of a folder, in the order of their names.
fn pictures(folder: &Path) -> std::io::Result<Vec<PathBuf>> {
    let mut files = vec![];
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        let ends = path
            .extension()
            .is_some_and(|end| end.eq_ignore_ascii_case("png"));
        if ends {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

impl Folder {
    fn read(&self, path: &Path, into: &mut [u8]) -> Result<(), Refusal> {
        let [rows, columns, bytes] = self.shape;
        let wanted = format!(
            "give PNG files of {columns} by {rows} pixels, 8 bits, as the channel has them"
        );
        let refused = |wrong: String| Refusal::new(path.display(), wrong, &wanted);
        let file = lads_host::input::open(path).map_err(|error| refused(error.to_string()))?;
        let mut decoder = png::Decoder::new(BufReader::new(file));
        decoder.set_transformations(png::Transformations::EXPAND);
        let mut reader = decoder
            .read_info()
            .map_err(|error| refused(error.to_string()))?;
        let (colour, depth) = reader.output_color_type();
        let [width, height] = [reader.info().width, reader.info().height];
        if [height as usize, width as usize] != [rows, columns] {
            return Err(refused(format!("it is {width} by {height} pixels")));
        }
        if depth != png::BitDepth::Eight || colour.samples() != bytes {
            return Err(refused(format!(
                "its pixels are {colour:?} of {} bits, not {bytes} bytes",
                depth as u8
            )));
        }
        // Size, depth and samples are the channel's, so the frame fits.
        let read = reader.next_frame(into);
        read.map(drop).map_err(|error| refused(error.to_string()))
    }
}
