//! Describes the machine and the versions that the measurements belong to. What a system does not tell is left out.

use std::fs;
use std::process::Command;

use serde_json::{Value, json};

fn first_line(program: &str, arguments: &[&str]) -> Option<String> {
    let output = Command::new(program).args(arguments).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    text.lines().next().map(str::to_owned)
}

/// Reads a field of `/proc/cpuinfo`.
fn cpu(field: &str) -> Option<String> {
    let text = fs::read_to_string("/proc/cpuinfo").ok()?;
    let line = text.lines().find(|line| line.starts_with(field))?;
    line.split_once(':')
        .map(|(_, value)| value.trim().to_owned())
}

/// Sizes of the data caches of the first core, innermost first.
fn caches() -> Vec<String> {
    let folder = "/sys/devices/system/cpu/cpu0/cache";
    let read =
        |index: usize, file: &str| fs::read_to_string(format!("{folder}/index{index}/{file}"));
    (0..5)
        .filter(|&index| read(index, "type").is_ok_and(|kind| kind.trim() != "Instruction"))
        .filter_map(|index| {
            let (level, size) = (read(index, "level").ok()?, read(index, "size").ok()?);
            Some(format!("L{} {}", level.trim(), size.trim()))
        })
        .collect()
}

/// Describes machine and versions as JSON.
pub fn describe() -> Value {
    let cores = std::thread::available_parallelism().map_or(0, std::num::NonZero::get);
    let load = fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let load: Vec<_> = load.split_whitespace().take(3).collect();
    let kernel = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    let vectors = [
        "avx2",
        "avx512f",
        "avx512_vnni",
        "avx512_bf16",
        "avx512_fp16",
    ];
    let flags = cpu("flags").unwrap_or_default();
    let vectors: Vec<_> = vectors
        .into_iter()
        .filter(|flag| flags.split(' ').any(|f| f == *flag))
        .collect();
    let model = [
        cpu("model name"),
        cpu("cpu family").map(|family| format!("family {family}")),
    ];
    let model: Vec<_> = model
        .into_iter()
        .flatten()
        .chain(cpu("model\t").map(|m| format!("model {m}")))
        .collect();
    json!({
        "cpu": model.join(", "),
        "cores": cores,
        "caches": caches(),
        "vectors": vectors,
        "virtual": flags.split(' ').any(|flag| flag == "hypervisor"),
        "kernel": kernel.trim(),
        "load_average": load.join(" "),
        "rustc": first_line("rustc", &["--version"]),
        "lads": env!("CARGO_PKG_VERSION"),
        "commit": first_line("git", &["rev-parse", "--short", "HEAD"]),
        "date": first_line("date", &["-u", "+%Y-%m-%d %H:%M UTC"]),
    })
}
