//! The small LADS policy behind a guard.

use lads_core::{GuardConfig, GuardError, GuardedController};

use super::assemble::parts;
use super::{Image, Memory, Model, Spec};

/// Control period of the test policy's contract, in seconds.
pub const PERIOD: f32 = 0.08;

/// Returns an image of the policy with a recorded episode.
pub fn image() -> Image {
    parts(&Model::random(Spec::TINY, 11))
        .with_golden(12)
        .image()
}

/// Runs `f` on a guarded controller in memory full of garbage that must not matter.
pub fn guarded<T>(
    config: &GuardConfig,
    f: impl FnOnce(&mut GuardedController) -> T,
) -> Result<T, GuardError> {
    let image = image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut guard = vec![f32::NAN; GuardedController::memory_len(&policy)];
    let mut guarded = GuardedController::new(memory.controller(&policy), config, &mut guard)?;
    Ok(f(&mut guarded))
}
