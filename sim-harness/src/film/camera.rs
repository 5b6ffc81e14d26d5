//! A state of the simulator as a picture, drawn off-screen through EGL. What can fail: no EGL, no such camera.
//!
//! Mesa draws in software where there is no GPU; shadows and smoothed edges at the resolution that the scenes ask for would take it a
//! second per picture, so the camera leaves shadows out and takes fewer samples. Making a camera takes about a second.

use mujoco_rs::prelude::MjtObjBase;
use mujoco_rs::renderer::{MjRenderer, RendererError};
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_visualization::{MjtCamera, MjvCamera};

use super::FilmError;
use crate::environment::{Environment, Stage, View};

/// Edge of the shadow map in texels: no shadows.
const SHADOW_SIZE: i32 = 0;
/// Samples per pixel.
const SAMPLES: i32 = 4;

/// Draws pictures of one size.
pub struct Camera {
    renderer: MjRenderer,
}

impl Camera {
    /// A camera in the scene of `environment`, for pictures of `width` by `height` pixels.
    pub fn new(
        environment: &mut dyn Environment,
        [width, height]: [u32; 2],
    ) -> Result<Self, FilmError> {
        let stage = stage(environment)?;
        let mut model = MjModel::clone(stage.data.model());
        let visual = model.vis_mut();
        visual.quality.shadowsize = SHADOW_SIZE;
        visual.quality.offsamples = SAMPLES;
        visual.global.offwidth = width as i32;
        visual.global.offheight = height as i32;
        let camera = camera(&model, stage.view)?;
        let renderer = MjRenderer::builder()
            .width(width)
            .height(height)
            .camera(camera)
            .build(&model)
            .map_err(|error| FilmError::NoEgl(whole(&error)))?;
        Ok(Self { renderer })
    }

    /// The state as it is now: rows from the top, three bytes (red, green, blue) per pixel.
    pub fn shoot(&mut self, environment: &mut dyn Environment) -> Result<&[u8], FilmError> {
        let failed = |error: RendererError| FilmError::Draw(whole(&error));
        let stage = stage(environment)?;
        self.renderer.sync_data(stage.data).map_err(failed)?;
        self.renderer.render().map_err(failed)?;
        Ok(self.renderer.rgb_flat().unwrap_or_default())
    }
}

fn stage(environment: &mut dyn Environment) -> Result<Stage<'_>, FilmError> {
    let id = environment.id();
    environment.stage().ok_or(FilmError::NoStage(id))
}

fn camera(model: &MjModel, view: View) -> Result<MjvCamera, FilmError> {
    match view {
        View::Camera(name) => model
            .name_to_id(MjtObjBase::mjOBJ_CAMERA, name)
            .map(MjvCamera::new_fixed)
            .ok_or(FilmError::NoCamera(name)),
        View::Free {
            look_at,
            distance,
            azimuth,
            elevation,
        } => Ok(MjvCamera {
            type_: MjtCamera::mjCAMERA_FREE as i32,
            lookat: look_at,
            distance,
            azimuth,
            elevation,
            ..MjvCamera::default()
        }),
    }
}

/// An error with its causes, in one line.
fn whole(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(inner) = cause {
        text = format!("{text}: {inner}");
        cause = inner.source();
    }
    text
}
