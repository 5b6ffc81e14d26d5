//! Registry of the environments, by the id that a bundle's contract names.
//!
//! The one place that knows them all: everything else works with the [`Environment`] trait. A scene is loaded once and opened once per
//! thread. What can fail: an id or noise level that nobody knows, assets that were not set up.

use std::path::Path;

use thiserror::Error;

use crate::environment::Environment;
use crate::kitchen::{self, Kitchen};
use crate::lorel::{self, Lorel};

/// Opens one more environment in a loaded scene.
pub type Opener = Box<dyn Fn() -> Box<dyn Environment> + Send + Sync>;

/// Default noise level of an environment; `None` for an unknown id.
pub fn default_noise(id: &str) -> Option<&'static str> {
    let found = ENVIRONMENTS.iter().find(|known| known.id == id);
    found.map(|known| known.noise)
}

/// Ids of the environments.
pub fn ids() -> impl Iterator<Item = &'static str> {
    ENVIRONMENTS.iter().map(|known| known.id)
}

/// Loads a scene from the vendor folder, for one noise level.
type Loader = fn(&Path, &str) -> Result<Opener, LoadError>;

struct Known {
    id: &'static str,
    /// Default noise level of the environment.
    noise: &'static str,
    load: Loader,
}

const ENVIRONMENTS: [Known; 2] = [
    Known {
        id: kitchen::ID,
        noise: "v0",
        load: load_kitchen,
    },
    Known {
        id: lorel::ID,
        noise: lorel::NOISE,
        load: load_lorel,
    },
];

/// Why an environment cannot be loaded.
#[derive(Debug, Error)]
pub enum LoadError {
    /// No environment has this id.
    #[error("no environment is called '{id}' (known: {known})")]
    UnknownId {
        /// The id that was asked for.
        id: String,
        /// All known ids.
        known: String,
    },
    /// The environment has no such noise level.
    #[error("{0}")]
    Noise(String),
    /// The kitchen's scene cannot be loaded.
    #[error(transparent)]
    Kitchen(#[from] kitchen::SceneError),
    /// The `LOReL` table's scene cannot be loaded.
    #[error(transparent)]
    Lorel(#[from] lorel::SceneError),
}

/// Loads the environment called `id` at a noise level of its own naming, with its assets below `vendor`.
pub fn load(id: &str, noise: &str, vendor: &Path) -> Result<Opener, LoadError> {
    match ENVIRONMENTS.iter().find(|known| known.id == id) {
        Some(known) => (known.load)(vendor, noise),
        None => Err(LoadError::UnknownId {
            id: id.to_owned(),
            known: ENVIRONMENTS.map(|known| known.id).join(", "),
        }),
    }
}

fn load_kitchen(vendor: &Path, noise: &str) -> Result<Opener, LoadError> {
    let noise = noise.parse().map_err(LoadError::Noise)?;
    let scene = kitchen::Scene::load(vendor)?;
    Ok(Box::new(move || Box::new(Kitchen::new(&scene, noise))))
}

fn load_lorel(vendor: &Path, noise: &str) -> Result<Opener, LoadError> {
    if noise != lorel::NOISE {
        return Err(LoadError::Noise(format!(
            "noise '{noise}' is unknown: {} observes without noise, so give {}",
            lorel::ID,
            lorel::NOISE
        )));
    }
    let scene = lorel::Scene::load(vendor)?;
    Ok(Box::new(move || Box::new(Lorel::new(&scene))))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(id: &str, noise: &str) -> String {
        load(id, noise, Path::new("no-such-folder"))
            .err()
            .unwrap()
            .to_string()
    }

    #[test]
    fn refusals_name_what_is_wrong() {
        assert_eq!(
            refusal("ant-maze", "v0"),
            "no environment is called 'ant-maze' (known: franka-kitchen, lorel-table)"
        );
        assert!(refusal(kitchen::ID, "v7").contains("v7"));
        let missing = refusal(kitchen::ID, "v0");
        assert!(
            missing.contains("no-such-folder") && missing.contains("make setup"),
            "{missing}"
        );
    }
}
