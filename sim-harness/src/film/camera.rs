//! Draws a state of the simulator off-screen through EGL, for films and for the viewer's window. What can fail: no EGL, no such camera.
//!
//! Mesa draws in software where there is no GPU; shadows and smoothed edges at the resolution that the scenes ask for would take it a
//! second per picture, so the camera leaves shadows out and takes fewer samples. Making a camera takes about a second.

use std::sync::Arc;

use mujoco_rs::prelude::MjtObjBase;
use mujoco_rs::renderer::{MjRenderer, RendererError};
use mujoco_rs::wrappers::mj_visualization::{MjtCamera, MjtMouse, MjvCamera};
use mujoco_rs::wrappers::{MjData, MjModel};

use super::FilmError;
use crate::environment::{Environment, Stage, View};

/// Size, samples and shadows of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Quality {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Samples per pixel.
    pub samples: i32,
    /// Edge of the shadow map in texels; 0 for no shadows.
    pub shadow_size: i32,
}

impl Quality {
    /// Returns the quality of films and windows.
    fn film(size: [u32; 2]) -> Self {
        Self {
            size,
            samples: 4,
            shadow_size: 0,
        }
    }
}

/// Draws pictures of one size of the simulator's state.
pub struct Camera {
    renderer: MjRenderer,
    model: MjModel,
    quality: Quality,
}

/// Motions of a free camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Motion {
    /// Turns around the point that the camera looks at.
    Turn,
    /// Moves camera and that point across the picture.
    Shift,
    /// Moves camera and that point over the floor.
    Glide,
    /// Moves the camera towards the point that it looks at, or away from it.
    Zoom,
}

impl Camera {
    /// Makes a camera in the scene of `environment`, for pictures of `width` by `height` pixels.
    pub fn new(environment: &mut dyn Environment, size: [u32; 2]) -> Result<Self, FilmError> {
        let stage = stage(environment)?;
        let model = MjModel::clone(stage.data.model());
        Self::of(model, &stage.view, Quality::film(size))
    }

    /// A camera in a scene of its own.
    pub(crate) fn of(model: MjModel, view: &View, quality: Quality) -> Result<Self, FilmError> {
        let camera = camera(&model, view)?;
        Self::build(model, camera, quality)
    }

    /// Makes a camera that [`steer`](Self::steer) can move: a camera of the scene is replaced by a free one at its place after a reset.
    pub fn free(environment: &mut dyn Environment, size: [u32; 2]) -> Result<Self, FilmError> {
        let stage = stage(environment)?;
        let mut model = MjModel::clone(stage.data.model());
        let mut camera = camera(&model, &stage.view)?;
        if let View::Camera(_) = stage.view {
            camera = freed(&camera, stage.data, &mut model);
        }
        Self::build(model, camera, Quality::film(size))
    }

    fn build(mut model: MjModel, camera: MjvCamera, quality: Quality) -> Result<Self, FilmError> {
        let visual = model.vis_mut();
        let [width, height] = quality.size;
        visual.quality.shadowsize = quality.shadow_size;
        visual.quality.offsamples = quality.samples;
        visual.global.offwidth = width as i32;
        visual.global.offheight = height as i32;
        let renderer = MjRenderer::builder()
            .width(width)
            .height(height)
            .camera(camera)
            .build(&model)
            .map_err(|error| FilmError::NoEgl(whole(&error)))?;
        Ok(Self {
            renderer,
            model,
            quality,
        })
    }

    /// Sets the size of the following pictures.
    pub fn resize(&mut self, size: [u32; 2]) -> Result<(), FilmError> {
        *self = Self::build(
            self.model.clone(),
            self.renderer.camera().clone(),
            Quality {
                size,
                ..self.quality
            },
        )?;
        Ok(())
    }

    /// Width and height of the pictures in pixels.
    pub fn size(&self) -> [u32; 2] {
        self.quality.size
    }

    /// Moves a free camera by a share of the picture's height, to the right and down.
    pub fn steer(&mut self, motion: Motion, [right, down]: [f64; 2]) {
        let action = match motion {
            Motion::Turn => MjtMouse::mjMOUSE_ROTATE_V,
            Motion::Shift => MjtMouse::mjMOUSE_MOVE_V,
            Motion::Glide => MjtMouse::mjMOUSE_MOVE_H,
            Motion::Zoom => MjtMouse::mjMOUSE_ZOOM,
        };
        let camera = self.renderer.camera_mut();
        camera.move_(action, &self.model, right, down);
    }

    /// Takes over the simulator's present state, to be drawn.
    pub fn see(&mut self, data: &mut MjData<Arc<MjModel>>) -> Result<(), FilmError> {
        let seen = self.renderer.sync_data(data);
        seen.map_err(|error| FilmError::Draw(whole(&error)))
    }

    /// Draws the state that [`see`](Self::see) took over: rows from the top, three bytes (red, green, blue) per pixel.
    pub fn draw(&mut self) -> Result<&[u8], FilmError> {
        let drawn = self.renderer.render();
        drawn.map_err(|error: RendererError| FilmError::Draw(whole(&error)))?;
        Ok(self.renderer.rgb_flat().unwrap_or_default())
    }

    /// Draws the present state of `environment`, in the form of [`draw`](Self::draw).
    pub fn shoot(&mut self, environment: &mut dyn Environment) -> Result<&[u8], FilmError> {
        self.see(stage(environment)?.data)?;
        self.draw()
    }
}

/// Makes a free camera at the place of a fixed one, with its field of view; it turns around the point before it that is nearest to the
/// scene's middle.
fn freed(fixed: &MjvCamera, data: &MjData<Arc<MjModel>>, model: &mut MjModel) -> MjvCamera {
    let (at, forward, ..) = fixed.frame(data);
    let middle = &model.stat().center;
    let to_middle = at.iter().zip(middle).map(|(at, middle)| middle - at);
    let depth: f64 = to_middle.zip(forward).map(|(way, ahead)| way * ahead).sum();
    let distance = depth.max(0.1 * model.stat().extent);
    let mut lookat = at;
    for (point, ahead) in lookat.iter_mut().zip(forward) {
        *point += distance * ahead;
    }
    if let Some(&fovy) = model.cam_fovy().get(fixed.fixedcamid as usize) {
        model.vis_mut().global.fovy = fovy as f32;
    }
    MjvCamera {
        type_: MjtCamera::mjCAMERA_FREE as i32,
        lookat,
        distance,
        azimuth: forward[1].atan2(forward[0]).to_degrees(),
        elevation: forward[2].clamp(-1.0, 1.0).asin().to_degrees(),
        ..MjvCamera::default()
    }
}

fn stage(environment: &mut dyn Environment) -> Result<Stage<'_>, FilmError> {
    let id = environment.id();
    environment.stage().ok_or(FilmError::NoStage(id))
}

fn camera(model: &MjModel, view: &View) -> Result<MjvCamera, FilmError> {
    match view {
        View::Camera(name) => model
            .name_to_id(MjtObjBase::mjOBJ_CAMERA, name)
            .map(MjvCamera::new_fixed)
            .ok_or_else(|| FilmError::NoCamera(name.to_string())),
        View::Free {
            look_at,
            distance,
            azimuth,
            elevation,
        } => Ok(MjvCamera {
            type_: MjtCamera::mjCAMERA_FREE as i32,
            lookat: *look_at,
            distance: *distance,
            azimuth: *azimuth,
            elevation: *elevation,
            ..MjvCamera::default()
        }),
    }
}

/// Formats an error with its causes, in one line.
fn whole(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(inner) = cause {
        text = format!("{text}: {inner}");
        cause = inner.source();
    }
    text
}
