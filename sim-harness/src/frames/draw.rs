//! Drawing the frames of states.

use std::sync::Arc;

use mujoco_rs::prelude::MjtObjBase;
use mujoco_rs::wrappers::{MjData, MjModel};

use super::Rendering;
use super::squeeze::squeeze;
use crate::environment::Environment;
use crate::film::FilmError;
use crate::film::camera::{Camera, Quality};

/// Draws the frames of one rendering. Making it takes about a second, a frame of 64x64 some 20 ms where there is no GPU.
pub struct Frames {
    camera: Camera,
    data: MjData<Arc<MjModel>>,
    rendering: Rendering,
    squeezed: Vec<u8>,
}

impl Frames {
    /// Frames of the scene of `environment`.
    pub fn new(environment: &dyn Environment, rendering: &Rendering) -> Result<Self, FilmError> {
        let refused = |reason: String| FilmError::Rendering(reason);
        rendering.check().map_err(refused)?;
        let scenery = environment.scenery(rendering.mesh_cell_m);
        let scenery = scenery.ok_or_else(|| FilmError::NoStage(environment.id()))?;
        let mut model = scenery.map_err(refused)?;
        for name in &rendering.hidden {
            let body = model.name_to_id(MjtObjBase::mjOBJ_BODY, name);
            let body = body.ok_or_else(|| refused(format!("the scene has no body '{name}'")))?;
            let owners = model.geom_bodyid().to_vec();
            let all = model.geom_rgba_mut().iter_mut().zip(owners);
            for (colour, _) in all.filter(|&(_, owner)| owner as usize == body) {
                colour[3] = 0.0;
            }
        }
        if !rendering.reflections {
            model.mat_reflectance_mut().fill(0.0);
        }
        model.vis_mut().map.shadowclip = rendering.shadow_clip as f32;
        let [rows, columns] = rendering.drawn;
        let quality = Quality {
            size: [columns, rows],
            samples: rendering.samples as i32,
            shadow_size: rendering.shadow_size as i32,
        };
        let camera = Camera::of(model.clone(), &rendering.view, quality)?;
        let data = MjData::try_new(Arc::new(model)).map_err(|error| refused(error.to_string()))?;
        Ok(Self {
            camera,
            data,
            rendering: rendering.clone(),
            squeezed: vec![0; rendering.frame_len()],
        })
    }

    /// The frame of a state: rows from the top, red, green and blue of each pixel.
    pub fn draw(&mut self, positions: &[f64]) -> Result<&[u8], FilmError> {
        let own = self.data.qpos_mut();
        if own.len() != positions.len() {
            return Err(FilmError::Rendering(format!(
                "the scene has {} positions, the state {}",
                own.len(),
                positions.len()
            )));
        }
        own.copy_from_slice(positions);
        self.data.kinematics();
        self.data.camlight();
        self.camera.see(&mut self.data)?;
        let drawn = self.camera.draw()?;
        if self.rendering.drawn == self.rendering.size {
            return Ok(drawn);
        }
        let Rendering {
            drawn: from, size, ..
        } = self.rendering;
        squeeze(drawn, from, size, &mut self.squeezed);
        Ok(&self.squeezed)
    }
}
