//! The program image that runs, compiled from the bundle now or earlier, and the instruction set that its kernels run on.
//!
//! What can fail: a bundle that does not compile; an image that cannot be read, is broken or is another bundle's; instructions that this CPU
//! does not have.

use std::path::{Path, PathBuf};

use lads_compiler::{Bundle, Options};
use lads_core::{Isa, Policy};
use lads_host::{Memory, Opened};

use crate::arguments::{IsaName, PolicyArguments};
use crate::end::{End, refused};

/// A bundle, its program image, and the instruction set that the image runs on.
pub struct Program {
    image: Opened,
    bundle: Bundle,
    model: PathBuf,
    isa: Isa,
}

impl Program {
    pub fn open(asked: &PolicyArguments) -> Result<Self, End> {
        let isa = isa(asked.isa)?;
        let model = &asked.model;
        let program = |image, bundle| Self {
            image,
            bundle,
            model: model.clone(),
            isa,
        };
        let Some(path) = &asked.image else {
            let options = if asked.exact {
                Options::exact()
            } else {
                Options::default()
            };
            let image = lads_host::open_with(model, &options).map_err(refused)?;
            let Some(bundle) = image.bundle().cloned() else {
                let wrong = "it is a compiled image; name its bundle, and the image with --image";
                return Err(about(model, &wrong));
            };
            return Ok(program(image, bundle));
        };
        let bundle = Bundle::open(model).map_err(refused)?;
        let image = lads_host::open(path).map_err(refused)?;
        if image.is_bundle() {
            return Err(about(path, &"it is a bundle; name a program image (.lads)"));
        }
        if image.policy().contract().bundle_sha256() != bundle.sha256() {
            let model = model.display();
            return Err(about(
                path,
                &format_args!(
                    "it was compiled from another bundle than {model}; compile it again from the bundle, with lads compile"
                ),
            ));
        }
        Ok(program(image, bundle))
    }

    /// Returns the checked view of the image.
    pub fn policy(&self) -> Policy<'_> {
        self.image.policy()
    }

    /// Instruction set that the image runs on.
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Replays the bundle's golden episode; refuses a policy that gives other answers on this machine.
    pub fn self_test(&self) -> Result<(), End> {
        let policy = self.policy();
        let about = |wrong: &dyn std::fmt::Display| about(&self.model, wrong);
        let mut memory = Memory::of(&policy).map_err(|error| about(&error))?;
        let controller = memory.controller_with(&policy, self.isa);
        let mut controller = controller.map_err(|error| about(&error))?;
        let tested = controller.self_test().map_err(|error| {
            about(&format_args!(
                "the self-test failed: {error}; export the bundle again"
            ))
        });
        tested.map(drop)
    }

    /// Returns the bundle that the image was compiled from.
    pub fn bundle(&self) -> &Bundle {
        &self.bundle
    }
}

/// Finds the instruction set that was asked for, if this CPU has it.
fn isa(name: Option<IsaName>) -> Result<Isa, End> {
    let Some(name) = name else {
        return Ok(Isa::detect());
    };
    let name = format!("{name:?}").to_lowercase();
    Isa::all().find(|isa| isa.name() == name).ok_or_else(|| {
        let offered: Vec<_> = Isa::all().map(Isa::name).collect();
        refused(format!(
            "--isa {name}: this CPU does not have it; it has {}",
            offered.join(", ")
        ))
    })
}

fn about(path: &Path, wrong: &dyn std::fmt::Display) -> End {
    refused(format_args!("{}: {wrong}", path.display()))
}
