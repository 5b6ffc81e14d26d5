//! Which environments there are, by the id that a bundle's contract names.
//!
//! The one place that knows them all: everything else works with the [`Environment`] trait. A scene is loaded once and opened once per
//! thread. What can fail: an id or noise level that nobody knows, assets that were not set up.

use std::path::Path;

use thiserror::Error;

use crate::environment::Environment;
use crate::kitchen::{self, Kitchen, SceneError};

/// A loaded scene; calling it opens one environment in it.
pub type Opener = Box<dyn Fn() -> Box<dyn Environment> + Send + Sync>;

/// Loads a scene from the vendor folder, for one noise level.
type Loader = fn(&Path, &str) -> Result<Opener, LoadError>;

const ENVIRONMENTS: [(&str, Loader); 1] = [(kitchen::ID, load_kitchen)];

/// Why an environment cannot be loaded.
#[derive(Debug, Error)]
pub enum LoadError {
    /// No environment has this id.
    #[error("no environment is called '{id}' (known: {known})")]
    UnknownId {
        /// What was asked for.
        id: String,
        /// All there are.
        known: String,
    },
    /// The environment has no such noise level.
    #[error("{0}")]
    Noise(String),
    /// The kitchen's scene cannot be loaded.
    #[error(transparent)]
    Kitchen(#[from] SceneError),
}

/// Loads the environment called `id` at a noise level of its own naming, with its assets below `vendor`.
pub fn load(id: &str, noise: &str, vendor: &Path) -> Result<Opener, LoadError> {
    match ENVIRONMENTS.iter().find(|(known, _)| *known == id) {
        Some((_, loader)) => loader(vendor, noise),
        None => Err(LoadError::UnknownId {
            id: id.to_owned(),
            known: ENVIRONMENTS.map(|(known, _)| known).join(", "),
        }),
    }
}

fn load_kitchen(vendor: &Path, noise: &str) -> Result<Opener, LoadError> {
    let noise = noise.parse().map_err(LoadError::Noise)?;
    let scene = kitchen::Scene::load(vendor)?;
    Ok(Box::new(move || Box::new(Kitchen::new(&scene, noise))))
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
            "no environment is called 'ant-maze' (known: franka-kitchen)"
        );
        assert!(refusal(kitchen::ID, "v7").contains("v7"));
        let missing = refusal(kitchen::ID, "v0");
        assert!(
            missing.contains("no-such-folder") && missing.contains("make setup"),
            "{missing}"
        );
    }
}
