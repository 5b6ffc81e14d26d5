//! Lets the harness's binaries and tests find libmujoco with nothing exported by hand.
//!
//! `.cargo/config.toml` sets `MUJOCO_DYNAMIC_LINK_DIR` to `vendor/mujoco/lib`, which `make setup` fills. Two roads lead from a program to
//! that folder: an rpath, for programs that are started directly, and a link to the library inside `OUT_DIR`, which cargo puts on the
//! loader's path for `cargo run` and `cargo test`, dependent packages included.
//! Without the folder the build ends with one line that says what to run.

use std::path::{Path, PathBuf};
use std::{env, fs, io};

const VARIABLE: &str = "MUJOCO_DYNAMIC_LINK_DIR";

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed={VARIABLE}");
    let Some(folder) = env::var_os(VARIABLE).map(PathBuf::from) else {
        println!(
            "cargo::error={VARIABLE} is not set: build inside the project's folder, whose .cargo/config.toml sets it"
        );
        return;
    };
    println!(
        "cargo::rerun-if-changed={}",
        folder.join("libmujoco.so").display()
    );
    let Ok(library) = versioned_library(&folder) else {
        println!(
            "cargo::error=MuJoCo is missing from {}: run \"make setup\"",
            folder.display()
        );
        return;
    };
    let out_dir = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    if let Err(error) = link(&library, &out_dir) {
        println!(
            "cargo::error=cannot link {} into {}: {error}",
            library.display(),
            out_dir.display()
        );
        return;
    }
    println!("cargo::rustc-link-search=native={}", out_dir.display());
    println!("cargo::rustc-link-arg=-Wl,-rpath,{}", folder.display());
}

/// The file that programs ask for at run time: its name is the library's soname, with the full version.
fn versioned_library(folder: &Path) -> io::Result<PathBuf> {
    fs::metadata(folder.join("libmujoco.so"))?;
    fs::read_dir(folder)?
        .filter_map(|entry| entry.ok().map(|entry| entry.path()))
        .find(|path| {
            path.file_name()
                .is_some_and(|name| name.to_string_lossy().starts_with("libmujoco.so."))
        })
        .ok_or_else(|| io::Error::from(io::ErrorKind::NotFound))
}

fn link(library: &Path, out_dir: &Path) -> io::Result<()> {
    let target = out_dir.join(library.file_name().expect("a directory entry has a name"));
    match fs::remove_file(&target) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    std::os::unix::fs::symlink(library, target)
}
