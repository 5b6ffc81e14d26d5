//! Large meshes with fewer faces, for pictures in which their detail is smaller than a pixel.
//!
//! Vertices in the same cell of a grid become one in their middle, and faces that shrink to an edge or stand twice are left out. So
//! nothing moves by more than a cell's diagonal. Meshes with textures of their own stay whole. What can fail: MuJoCo refuses the scene.

use std::collections::{BTreeSet, HashMap};
use std::path::Path;

use mujoco_rs::prelude::MjtObjBase;
use mujoco_rs::wrappers::mj_editing::{MjtMeshInertia, SpecElement as _, SpecItem as _};
use mujoco_rs::wrappers::{MjModel, MjSpec};

/// Meshes with fewer faces are small already.
const MANY_FACES: usize = 2_000;

/// Compiles a scene with its large meshes put together in cells of so many metres; `whole` is the same scene compiled as it is.
pub(crate) fn thinned(mut scene: MjSpec, whole: &MjModel, cell: f64) -> Result<MjModel, String> {
    if cell > 0.0 {
        for mesh in scene.mesh_iter_mut() {
            let own = mesh.name().to_owned();
            let stem = Path::new(mesh.file()).file_stem();
            let stem = stem.map(|stem| stem.to_string_lossy().into_owned());
            let name = if own.is_empty() {
                stem.unwrap_or_default()
            } else {
                own
            };
            let id = whole.name_to_id(MjtObjBase::mjOBJ_MESH, &name);
            let Some(large) = id.and_then(|id| Mesh::large(whole, id)) else {
                continue;
            };
            let Mesh { vertices, faces } = large.clustered(cell);
            // The vertices are where the compiled scene has them, so nothing is left to be scaled or turned.
            mesh.scale_mut().fill(1.0);
            mesh.refpos_mut().fill(0.0);
            mesh.refquat_mut().copy_from_slice(&[1.0, 0.0, 0.0, 0.0]);
            mesh.set_inertia(MjtMeshInertia::mjMESH_INERTIA_SHELL);
            mesh.set_name(&name).map_err(|error| error.to_string())?;
            mesh.set_file("");
            let points = vertices.iter().flatten().map(|&x| x as f32);
            mesh.set_uservert(&points.collect::<Vec<f32>>());
            let corners = faces.iter().flatten().map(|&corner| corner as i32);
            mesh.set_userface(&corners.collect::<Vec<i32>>());
        }
    }
    scene.compile().map_err(|error| error.to_string())
}

/// Vertices in metres, and faces as triples of their places.
#[derive(Debug, Clone, PartialEq)]
struct Mesh {
    vertices: Vec<[f64; 3]>,
    faces: Vec<[usize; 3]>,
}

impl Mesh {
    /// A mesh of a compiled scene in the coordinates of its file; `None` for one that stays as it is.
    fn large(model: &MjModel, id: usize) -> Option<Self> {
        let range = |first: &[i32], len: &[i32]| {
            let (first, len) = (*first.get(id)? as usize, *len.get(id)? as usize);
            Some(first..first + len)
        };
        let faces = range(model.mesh_faceadr(), model.mesh_facenum())?;
        let textured = model.mesh_texcoordadr().get(id).is_some_and(|&at| at >= 0);
        if textured || faces.len() < MANY_FACES {
            return None;
        }
        let vertices = range(model.mesh_vertadr(), model.mesh_vertnum())?;
        let vertices = model.mesh_vert().get(vertices)?;
        let (shift, turn) = (model.mesh_pos().get(id)?, model.mesh_quat().get(id)?);
        let faces = model.mesh_face().get(faces)?.iter();
        Some(Self {
            vertices: vertices
                .iter()
                .map(|vertex| placed(vertex.map(f64::from), *shift, *turn))
                .collect(),
            faces: faces.map(|face| face.map(|at| at as usize)).collect(),
        })
    }

    /// Returns the mesh with one vertex for each cell of a grid.
    fn clustered(&self, cell: f64) -> Self {
        let mut places: HashMap<[i64; 3], usize> = HashMap::new();
        let mut sums: Vec<([f64; 3], f64)> = Vec::new();
        let mut of = Vec::with_capacity(self.vertices.len());
        for vertex in &self.vertices {
            let key = vertex.map(|x| (x / cell).floor() as i64);
            let place = *places.entry(key).or_insert(sums.len());
            if place == sums.len() {
                sums.push(([0.0; 3], 0.0));
            }
            let (sum, count) = &mut sums[place];
            for (sum, x) in sum.iter_mut().zip(vertex) {
                *sum += x;
            }
            *count += 1.0;
            of.push(place);
        }
        // A face begins with its smallest corner, so that one that stands twice is found.
        let faces: BTreeSet<[usize; 3]> = self
            .faces
            .iter()
            .map(|face| face.map(|at| of[at]))
            .filter(|[a, b, c]| a != b && b != c && c != a)
            .map(|mut face| {
                let first = (0..3).min_by_key(|&i| face[i]).unwrap_or(0);
                face.rotate_left(first);
                face
            })
            .collect();
        // Vertices of no face any more would still count for the mesh's frame.
        let used: BTreeSet<usize> = faces.iter().flatten().copied().collect();
        let new: HashMap<usize, usize> = used.iter().copied().zip(0..).collect();
        Self {
            vertices: used
                .iter()
                .map(|&place| {
                    let (sum, count) = sums[place];
                    sum.map(|sum| sum / count)
                })
                .collect(),
            faces: faces.iter().map(|face| face.map(|at| new[&at])).collect(),
        }
    }
}

/// A point turned by a quaternion (w, x, y, z), then shifted.
fn placed(point: [f64; 3], shift: [f64; 3], [w, x, y, z]: [f64; 4]) -> [f64; 3] {
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        ]
    };
    let axis = [x, y, z];
    let across = cross(axis, point);
    let twice = cross(axis, across);
    std::array::from_fn(|i| point[i] + 2.0 * (w * across[i] + twice[i]) + shift[i])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vertices_of_a_cell_become_one_and_faces_that_collapse_go() {
        let mesh = Mesh {
            vertices: vec![
                [0.1, 0.1, 0.1],
                [0.3, 0.1, 0.1],
                [1.5, 0.1, 0.1],
                [0.1, 1.5, 0.1],
                [5.0, 5.0, 5.0],
            ],
            faces: vec![[0, 1, 2], [0, 2, 3], [3, 1, 2], [2, 3, 0]],
        };
        let thin = mesh.clustered(1.0);
        assert_eq!(
            thin.vertices,
            [[0.2, 0.1, 0.1], [1.5, 0.1, 0.1], [0.1, 1.5, 0.1]]
        );
        assert_eq!(thin.faces, [[0, 1, 2]]);
    }

    #[test]
    fn a_point_is_turned_as_a_quaternion_says() {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let turned = placed([1.0, 0.0, 0.0], [0.0, 0.0, 2.0], [half, 0.0, 0.0, half]);
        for (got, wanted) in turned.iter().zip([0.0, 1.0, 2.0]) {
            assert!((got - wanted).abs() < 1e-12, "{turned:?}");
        }
    }
}
