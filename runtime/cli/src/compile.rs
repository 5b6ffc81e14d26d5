//! `lads compile`: turns a bundle into a program image, as a file, as source, or both.
//!
//! All refusals happen before the first file is written.

use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use clap::Args;
use lads_compiler::{Bundle, CacheFormat, Formats, Options, WeightFormat, named};
use lads_host::output;

use crate::model::Model;
use crate::refusal::Refusal;
use crate::{emit, print, self_test};

/// Options of `lads compile`.
#[derive(Debug, Args)]
pub struct Request {
    /// Bundle (.onnx); with --emit-c or --emit-rust also a compiled image (.lads)
    model: PathBuf,
    /// Path of the image to write
    #[arg(short, long, required_unless_present_any = ["emit_c", "emit_rust"])]
    output: Option<PathBuf>,
    /// Path of a C source to write: the image as a constant, aligned byte array
    #[arg(long, value_name = "FILE")]
    emit_c: Option<PathBuf>,
    /// Path of a Rust source to write: the image as a constant, aligned byte array
    #[arg(long, value_name = "FILE")]
    emit_rust: Option<PathBuf>,
    /// Storage format of the weights: auto, as the bundle was tuned (`lads-run tune`), and f32 if
    /// it was not; f32; int16 or int8, with which the inputs of a layer are rounded too, and which
    /// are faster than f32 on x86-64 and aarch64; f16 or bf16, which are decoded. Fewer bits than
    /// 32 have to pass a gate: the golden episode replays with the same plans, and with actions
    /// inside the tolerance
    #[arg(long, value_name = "FORMAT", default_value = "auto", value_parser = auto_or(weight_format))]
    weights: Choice<WeightFormat>,
    /// Storage format of the weights that the action depends on, not only the choice of a plan, if
    /// it differs: with f32 the actions of a plan keep their bits, so fewer bits elsewhere can only
    /// change which plan is chosen
    #[arg(long, value_name = "FORMAT", value_parser = weight_format)]
    low_level: Option<WeightFormat>,
    /// Storage format of the KV cache: auto, as the bundle was tuned if no format of the weights is
    /// given, else f32; f32; f16 in half the memory; or int8 in a quarter. Fewer bits have to pass the same gate as
    /// weights
    #[arg(long, value_name = "FORMAT", default_value = "auto", value_parser = auto_or(cache_format))]
    cache: Choice<CacheFormat>,
    /// Largest difference of an action that the gate, and later the image's self-test, accept, in
    /// the action's units; the bundle's own tolerance is meant for 32-bit weights
    #[arg(long, value_name = "DIFFERENCE", value_parser = tolerance)]
    tolerance: Option<f32>,
    /// Write an image that the gate refuses, for experiments; its self-test fails
    #[arg(long)]
    force: bool,
}

/// Compiles a bundle and writes the requested files.
pub fn compile(request: Request) -> Result<(), Refusal> {
    // A file that is not a bundle is refused below, with its actual kind.
    let bundle = Bundle::open(&request.model).ok();
    let formats = Formats {
        weights: request.weights.0,
        low_level: request.low_level,
        cache: request.cache.0,
    };
    let storage = bundle.as_ref().map(|bundle| formats.storage(bundle));
    let storage = storage
        .transpose()
        .map_err(|error| Refusal::with_remedy_inside(request.model.display(), error))?;
    let options = Options {
        storage: storage.flatten(),
        tolerance: request.tolerance,
        force: request.force,
    };
    let Request {
        model,
        output,
        emit_c,
        emit_rust,
        force,
        ..
    } = request;
    let outputs: Vec<_> = [
        ("-o", &output),
        ("--emit-c", &emit_c),
        ("--emit-rust", &emit_rust),
    ]
    .into_iter()
    .filter_map(|(option, path)| Some((option, path.as_deref()?)))
    .collect();
    output::check(&[("", &model)], &outputs).map_err(Refusal::of)?;
    let model = Model::compile(&model, &options)?;
    let asked = formats != Formats::default() || options != Options::default();
    let again = output.is_some() || asked;
    if again && !model.is_bundle() {
        return Err(Refusal::new(
            model.path.display(),
            "it is a compiled image already",
            "give the bundle (.onnx)",
        ));
    }
    let image = model.image();
    // Everything that can be refused is, before the first file is written.
    let c = emit_c.map(|path| emit::c(image, &path).map(|text| (path, text)));
    let rust = emit_rust.map(|path| emit::rust(image, &path).map(|text| (path, text)));
    let sources = [c.transpose()?, rust.transpose()?];
    let sources = sources
        .iter()
        .flatten()
        .map(|(path, text)| (path, text.as_bytes()));
    let mut drafts = vec![];
    for (path, bytes) in output.iter().map(|path| (path, image)).chain(sources) {
        let draft = output::draft(path).and_then(|mut draft| {
            draft.write_all(bytes)?;
            Ok(draft)
        });
        let draft = draft.map_err(|error| unwritable(path, &error))?;
        drafts.push((path, bytes.len(), draft));
    }
    for (path, bytes, draft) in drafts {
        draft.commit().map_err(|error| unwritable(path, &error))?;
        print(&format!("{}: {bytes} bytes\n", path.display()))?;
    }
    let Some(bundle) = bundle else {
        return Ok(());
    };
    // What does not read was refused above.
    let storage = options.storage(&bundle).unwrap_or_default();
    if storage.is_exact() || force {
        return if options.storage.is_none() && matches!(bundle.tuned(), Ok(None)) {
            print("f32 weights: the bundle is not tuned to fewer bits; `lads-run tune` does it\n")
        } else {
            Ok(())
        };
    }
    let line = self_test::self_test(&model)?;
    print(&format!("{storage}: {line}\n"))
}

pub fn weight_format(name: &str) -> Result<WeightFormat, String> {
    named(name, WeightFormat::ALL, WeightFormat::name)
}

fn cache_format(name: &str) -> Result<CacheFormat, String> {
    named(name, CacheFormat::ALL, CacheFormat::name)
}

/// A format, or `auto` as `None`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Choice<T>(pub(crate) Option<T>);

/// Makes a parser that also accepts `auto`.
pub(crate) fn auto_or<T>(
    format: fn(&str) -> Result<T, String>,
) -> impl Fn(&str) -> Result<Choice<T>, String> + Clone {
    move |name| match name {
        "auto" => Ok(Choice(None)),
        _ => format(name).map(|format| Choice(Some(format))),
    }
}

fn tolerance(text: &str) -> Result<f32, String> {
    let number: Option<f32> = text.parse().ok();
    let positive = number.filter(|number| number.is_finite() && *number > 0.0);
    positive.ok_or_else(|| "it has to be a positive number".into())
}

fn unwritable(path: &Path, error: &io::Error) -> Refusal {
    Refusal::new(
        path.display(),
        error,
        "name a file in an existing, writable folder",
    )
}
