//! Memory of a batch: what it takes is refused before any of it is touched, if the machine does not
//! have it.
//!
//! Linux says in `/proc/meminfo` what it can give; elsewhere [`ELSEWHERE`] is the limit.

use lads_core::Policy;
use lads_host::Memory;
use pyo3::prelude::*;

use crate::errors::InputError;

/// Bytes that are always tried: asking the system takes longer than to allocate them.
const SMALL: u64 = 256 << 20;

/// Largest memory of a batch where the system does not say what it has, in bytes.
const ELSEWHERE: u64 = 64 << 30;

/// Refuses more controllers than this machine has memory for; the exception names the limit.
pub fn afford(policy: &Policy<'_>, count: u64) -> PyResult<()> {
    let contract = policy.contract();
    // An action is kept by its row and by the batch; an element of bytes is counted as one of floats.
    let observed: usize = contract.observations().map(|channel| channel.len()).sum();
    let elements = observed + 2 * contract.action_len();
    let each = (Memory::bytes(policy) + elements * size_of::<f32>()) as u64;
    let asked = u128::from(count) * u128::from(each);
    if asked <= u128::from(SMALL) {
        return Ok(());
    }
    let most = available().unwrap_or(ELSEWHERE);
    if asked <= u128::from(most) {
        return Ok(());
    }
    Err(InputError::new_err(format!(
        "count: {count} controllers take {}, {} each, and this machine has {} left; give at most {}",
        size(asked as f64),
        size(each as f64),
        size(most as f64),
        most / each
    )))
}

/// Returns the bytes that the system can give to programs, if it says so.
fn available() -> Option<u64> {
    let told = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = told
        .lines()
        .find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let kilobytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    kilobytes.checked_mul(1024)
}

/// Writes a number of bytes in the largest unit of which it is one or more.
fn size(bytes: f64) -> String {
    let units = ["B", "KiB", "MiB", "GiB", "TiB", "PiB", "EiB", "ZiB"];
    let mut scaled = bytes;
    let mut unit = units[0];
    for larger in &units[1..] {
        if scaled < 1024.0 {
            break;
        }
        scaled /= 1024.0;
        unit = larger;
    }
    format!("{scaled:.1} {unit}")
}
