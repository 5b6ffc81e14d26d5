//! What a camera of the simulation sees: frames for policies with image channels.
//!
//! A frame is a function of the simulator's positions alone, so states are stored and frames are made of them, in a scene of their own that
//! nothing else reads or moves. [`Rendering`] is everything that a frame depends on besides; a bundle's image channel and a cache of frames
//! carry it. [`thin`] takes detail out of meshes that no pixel shows, [`cache`] makes the frames of a dataset, [`stream`]
//! those of states as they come. What can fail: a
//! machine without EGL, a camera or body that the scene does not have, another number of positions.

#[cfg(feature = "camera")]
pub mod cache;
#[cfg(feature = "camera")]
mod draw;
#[cfg(feature = "camera")]
pub use lads_record::png;
#[cfg(feature = "camera")]
mod squeeze;
#[cfg(feature = "camera")]
pub mod stream;
pub mod thin;

use serde::{Deserialize, Serialize};

use crate::environment::View;

#[cfg(feature = "camera")]
pub use draw::Frames;

/// Settings that a frame depends on besides the state of the scene.
///
/// Two renderings differ in what a policy sees: without shadows lit surfaces are darker too, by a quarter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rendering {
    /// Viewpoint of the camera.
    pub view: View,
    /// Rows and columns of a frame.
    pub size: [u32; 2],
    /// Rows and columns that are drawn, at least as many; a frame's pixels are means over them, so another aspect ratio is squeezed.
    pub drawn: [u32; 2],
    /// Samples per drawn pixel; 0 for none besides its middle.
    pub samples: u32,
    /// Edge of the shadow map in texels; 0 for no shadows.
    pub shadow_size: u32,
    /// Half of the shadow map's extent, as a share of the scene's: the smaller, the sharper the shadows in the middle.
    pub shadow_clip: f64,
    /// Whether floors and boxes mirror what stands on them.
    pub reflections: bool,
    /// Bodies whose own geoms are left out.
    pub hidden: Vec<String>,
    /// Edge in metres of the cells that vertices of large meshes are put together in; 0 leaves meshes whole.
    pub mesh_cell_m: f64,
}

impl Rendering {
    /// Bytes of a frame: rows from the top, red, green and blue of each pixel.
    pub fn frame_len(&self) -> usize {
        let [rows, columns] = self.size;
        rows as usize * columns as usize * 3
    }

    /// Checks that frames can be drawn with this rendering; the error says what is wrong.
    pub fn check(&self) -> Result<(), String> {
        let ([rows, columns], [drawn_rows, drawn_columns]) = (self.size, self.drawn);
        let sides = [rows, columns, drawn_rows, drawn_columns];
        if sides.iter().any(|side| !(1..=4096).contains(side)) {
            return Err(format!(
                "size {:?} and drawn {:?} must be 1 to 4096 pixels",
                self.size, self.drawn
            ));
        }
        if drawn_rows < rows || drawn_columns < columns {
            return Err(format!(
                "drawn {:?} is smaller than size {:?}",
                self.drawn, self.size
            ));
        }
        let camera = match &self.view {
            View::Camera(name) => name.as_ref(),
            View::Free { .. } => "",
        };
        let mut names = self.hidden.iter().map(String::as_str).chain([camera]);
        if names.any(|name| name.contains('\0')) {
            return Err("a name of `view` or `hidden` has a null character".to_owned());
        }
        if self.samples > 64 || self.shadow_size > 16_384 {
            return Err("more than 64 samples or 16384 texels of shadow".to_owned());
        }
        let numbers = self.shadow_clip.is_finite() && self.shadow_clip >= 0.0;
        if !numbers || !(0.0..=1.0).contains(&self.mesh_cell_m) {
            return Err(format!(
                "shadow_clip {} must not be negative, mesh_cell_m {} must be 0 to 1",
                self.shadow_clip, self.mesh_cell_m
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{kitchen, lorel};

    #[test]
    fn a_rendering_survives_its_json_and_unknown_fields_are_refused() {
        for rendering in [
            lorel::spec::rendering(lorel::VIEW),
            kitchen::spec::rendering(kitchen::VIEW),
        ] {
            assert_eq!(rendering.check(), Ok(()));
            let json = serde_json::to_value(&rendering).unwrap();
            assert_eq!(
                serde_json::from_value::<Rendering>(json.clone()).unwrap(),
                rendering
            );
            let mut more = json;
            more["fog"] = true.into();
            let error = serde_json::from_value::<Rendering>(more).unwrap_err();
            assert!(error.to_string().contains("fog"), "{error}");
        }
    }

    #[test]
    fn what_cannot_be_drawn_is_named() {
        let good = lorel::spec::rendering(lorel::VIEW);
        let refused = |change: fn(&mut Rendering)| {
            let mut bad = good.clone();
            change(&mut bad);
            bad.check().unwrap_err()
        };
        assert!(refused(|it| it.size = [0, 64]).contains("[0, 64]"));
        assert!(refused(|it| it.drawn = [64, 63]).contains("smaller"));
        assert!(refused(|it| it.samples = 65).contains("samples"));
        assert!(refused(|it| it.mesh_cell_m = f64::NAN).contains("NaN"));
    }
}
