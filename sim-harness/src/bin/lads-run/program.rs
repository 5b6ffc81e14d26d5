//! The program image that runs, compiled from the bundle just now or before, and the instructions that its kernels run on.
//!
//! What can fail: a bundle that does not compile; an image that cannot be read, is broken or is another bundle's; instructions that this CPU
//! does not have.

use std::path::Path;

use lads_compiler::{Aligned, Bundle, Image, compile};
use lads_core::{Isa, Policy};

use crate::arguments::{Arguments, IsaName};
use crate::end::{End, refused};

/// An image and its memory.
pub enum Program {
    Compiled(Image),
    Read(Aligned),
}

impl Program {
    pub fn of(arguments: &Arguments, bundle: &Bundle) -> Result<Self, End> {
        let Some(path) = &arguments.image else {
            let image = compile(bundle);
            let image = image.map_err(|error| about(&arguments.model, &error))?;
            return Ok(Self::Compiled(image));
        };
        let again = "compile it again from the bundle, with lads compile";
        let bytes = lads_host::input::read(path)
            .map_err(|error| about(path, &format_args!("{error}; name a program image (.lads)")))?;
        let image = Aligned::new(&bytes);
        let policy = Policy::new_checked(image.as_bytes())
            .map_err(|error| about(path, &format_args!("{error}; {again}")))?;
        if !policy.checksum_matches() {
            let wrong = "its checksum does not match: it was changed after it was compiled";
            return Err(about(path, &format_args!("{wrong}; {again}")));
        }
        if policy.contract().bundle_sha256() != bundle.sha256() {
            let model = arguments.model.display();
            return Err(about(
                path,
                &format_args!("it was compiled from another bundle than {model}; {again}"),
            ));
        }
        Ok(Self::Read(image))
    }

    pub fn policy(&self, arguments: &Arguments) -> Result<Policy<'_>, End> {
        let bytes = match self {
            Self::Compiled(image) => image.as_bytes(),
            Self::Read(image) => image.as_bytes(),
        };
        Policy::new_checked(bytes).map_err(|error| {
            about(
                &arguments.model,
                &format_args!("{error}; export the bundle again"),
            )
        })
    }
}

/// The instructions that were asked for, if this CPU has them.
pub fn isa(name: Option<IsaName>) -> Result<Isa, End> {
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
