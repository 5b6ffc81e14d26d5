//! What cameras show a policy: after every control step, frames of the state that the environment is in.
//!
//! A channel of bytes is a camera's where its contract says how its frames are drawn ([`crate::frames::Rendering`]). A frame that could
//! not be drawn is an error, never an old one. What can fail: a rendering of something else than the channel, no EGL, a build without
//! cameras.

use lads_compiler::Contract;
use lads_compiler::contract::{Channel, DType};
use lads_core::{ChannelId, Data, Policy};
use lads_proof::frames::{self, Digest};
use thiserror::Error;

use crate::environment::Environment;
use crate::frames::Rendering;
use crate::trace::Picture;

/// Reason why a policy cannot be shown frames.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum SightError {
    /// A channel's rendering cannot be read, or is of frames of another size.
    #[error("channel `{channel}` of the contract: {wrong}")]
    Channel {
        /// Name of the channel.
        channel: String,
        /// Problem of the channel's rendering.
        wrong: String,
    },
    /// This program was built without a renderer.
    #[cfg(not(feature = "camera"))]
    #[error(
        "the policy sees images, and this program was built without cameras; build it with --features camera"
    )]
    NoCamera,
    /// A frame cannot be drawn.
    #[error("{0}")]
    Draw(String),
}

/// Returns the image channels of a contract with their renderings, in the order of the channels; refuses a rendering that does not fit its
/// channel.
pub fn renderings(contract: &Contract) -> Result<Vec<(&Channel, Rendering)>, SightError> {
    let images = contract.observations().filter(|channel| is_image(channel));
    images
        .map(|channel| {
            let wrong = |wrong: String| SightError::Channel {
                channel: channel.name.clone(),
                wrong,
            };
            let said = channel.rendering.clone();
            let said = said.ok_or_else(|| wrong("it does not say how it is rendered".into()))?;
            let rendering: Rendering = serde_json::from_value(said)
                .map_err(|error| wrong(format!("its rendering cannot be read: {error}")))?;
            rendering.check().map_err(wrong)?;
            let [rows, columns] = rendering.size.map(|side| side as usize);
            if channel.dtype != DType::U8 || channel.shape != [rows, columns, 3] {
                return Err(wrong(format!(
                    "its shape is {:?}, its rendering is of {rows} by {columns} pixels of 3 bytes",
                    channel.shape
                )));
            }
            Ok((channel, rendering))
        })
        .collect()
}

/// Whether a channel is no vector of numbers.
pub fn is_image(channel: &Channel) -> bool {
    channel.dtype == DType::U8 || channel.rendering.is_some()
}

/// The cameras of a policy with what they show now.
#[derive(Default)]
pub struct Sight {
    shown: Vec<Shown>,
    #[cfg(feature = "camera")]
    frames: Vec<crate::frames::Frames>,
}

/// What a camera shows now.
#[cfg_attr(
    not(feature = "camera"),
    expect(dead_code, reason = "nothing is drawn")
)]
struct Shown {
    id: ChannelId,
    /// Name of the channel.
    name: String,
    /// Rows and columns.
    size: [u32; 2],
    frame: Vec<u8>,
}

impl Sight {
    /// The cameras that a contract asks for, in the scene of `environment`; none for a policy without.
    pub fn of(
        contract: &Contract,
        policy: &Policy<'_>,
        environment: &dyn Environment,
    ) -> Result<Self, SightError> {
        let mut sight = Self::default();
        for (channel, rendering) in renderings(contract)? {
            let id = policy.contract().find(&channel.name).map(|own| own.id());
            let id = id.ok_or_else(|| SightError::Channel {
                channel: channel.name.clone(),
                wrong: "the image has no such channel".into(),
            })?;
            sight.add((id, &channel.name), environment, &rendering)?;
        }
        Ok(sight)
    }

    #[cfg(feature = "camera")]
    fn add(
        &mut self,
        (id, name): (ChannelId, &str),
        environment: &dyn Environment,
        rendering: &Rendering,
    ) -> Result<(), SightError> {
        let frames = crate::frames::Frames::new(environment, rendering);
        self.frames
            .push(frames.map_err(|error| SightError::Draw(error.to_string()))?);
        self.shown.push(Shown {
            id,
            name: name.to_owned(),
            size: rendering.size,
            frame: vec![0; rendering.frame_len()],
        });
        Ok(())
    }

    #[cfg(not(feature = "camera"))]
    #[expect(clippy::unused_self, reason = "nothing can be added")]
    fn add(
        &mut self,
        _: (ChannelId, &str),
        _: &dyn Environment,
        _: &Rendering,
    ) -> Result<(), SightError> {
        Err(SightError::NoCamera)
    }

    /// Looks at a state of the scene.
    #[cfg(feature = "camera")]
    pub fn look(&mut self, positions: &[f64]) -> Result<(), SightError> {
        for (Shown { frame: shown, .. }, frames) in self.shown.iter_mut().zip(&mut self.frames) {
            let frame = frames.draw(positions);
            let frame = frame.map_err(|error| SightError::Draw(error.to_string()))?;
            if frame.len() != shown.len() {
                let wrong = format!(
                    "a frame has {} bytes instead of {}",
                    frame.len(),
                    shown.len()
                );
                return Err(SightError::Draw(wrong));
            }
            shown.copy_from_slice(frame);
        }
        Ok(())
    }

    /// Does nothing: this program was built without cameras.
    #[cfg(not(feature = "camera"))]
    pub fn look(&mut self, _: &[f64]) -> Result<(), SightError> {
        Ok(())
    }

    /// Returns the frames that the cameras show, by channel, in the contract's order; none without cameras.
    pub fn shown(&self) -> impl Iterator<Item = (ChannelId, &[u8])> {
        self.shown.iter().map(|it| (it.id, it.frame.as_slice()))
    }

    /// Returns the frames as a control step takes them.
    pub fn given(&self) -> impl Iterator<Item = (ChannelId, Data<'_>)> {
        self.shown().map(|(id, shown)| (id, Data::U8(shown)))
    }

    /// Returns the frames as PNG files.
    #[cfg(feature = "camera")]
    pub fn pictures(&self) -> Result<Vec<Picture>, SightError> {
        let picture = |it: &Shown| {
            let png = crate::frames::png::encode(&it.frame, it.size).map_err(SightError::Draw)?;
            let channel = it.name.clone();
            Ok(Picture { channel, png })
        };
        self.shown.iter().map(picture).collect()
    }

    /// Returns no files: there is no camera.
    #[cfg(not(feature = "camera"))]
    pub fn pictures(&self) -> Result<Vec<Picture>, SightError> {
        Ok(Vec::new())
    }

    /// Returns the digest of the frames; `None` without cameras.
    pub fn digest(&self) -> Option<Digest> {
        let any = !self.shown.is_empty();
        any.then(|| frames::digest(self.shown().map(|(_, shown)| shown)))
    }
}
