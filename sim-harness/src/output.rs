//! Writes the harness's files: [`lads_host::output`], and JSON through it.

use std::io;
use std::path::Path;

pub use lads_host::output::{
    Draft, Named, OutputError, apart, check, draft, draft_with_folder, write,
};
use serde::Serialize;

/// Writes `value` to `path` as JSON.
pub fn write_json(value: &impl Serialize, path: &Path) -> io::Result<()> {
    let mut text = serde_json::to_vec_pretty(value)?;
    text.push(b'\n');
    write(path, &text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("r.json");
        std::fs::write(&target, "something much longer than what comes").unwrap();
        write_json(&[1, 2], &target).unwrap();
        let text = std::fs::read_to_string(&target).unwrap();
        assert!(text.ends_with('\n'));
        let read: Vec<u32> = serde_json::from_str(&text).unwrap();
        assert_eq!(read, [1, 2]);
    }
}
