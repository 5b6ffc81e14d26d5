//! Sets the instruction, and the rules for random choices.

use lads_core::{Decision, Instruction, Noise, similarity};

use super::{report_area, status, told};
use crate::handle::{self, areas_of};
use crate::memory::{Area, apart, check, read};
use crate::status::Status;
use crate::types::{
    LADS_NOISE_SEEDED, LADS_NOISE_ZERO, LadsController, LadsPolicy, LadsReport, Refusal,
};

/// Sets a known instruction, by its number, to follow from the next step on: a new episode.
/// `LADS_STATUS_INSTRUCT_FAILED`, which never occurs with a sound image, leaves the controller
/// without an instruction. A policy whose contract has no instruction channel needs none.
///
/// # Safety
/// The conditions of `lads_self_test` hold.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_set_instruction(
    controller: *mut LadsController,
    number: u32,
) -> Status {
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.and_then(|handle| {
        handle.guarded.set_instruction(Instruction::Id(number))?;
        Ok(())
    }))
}

/// Sets an instruction given as word embeddings, `len = n * word_dim` elements, like
/// `lads_set_instruction`. A policy follows any words, whatever they say: ask
/// `lads_instruction_similarity` first. `report`, which may be null, names the word element that
/// was refused.
///
/// # Safety
/// The conditions of `lads_self_test` hold; `words` points to `len` readable elements; `report` is null or may be read and written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_set_words(
    controller: *mut LadsController,
    words: *const f32,
    len: usize,
    report: *mut LadsReport,
) -> Status {
    // SAFETY: the caller guarantees all three.
    let handle = match unsafe { handle::handle(controller) } {
        Ok(handle) => handle,
        Err(status) => return status,
    };
    let [workspace, image] = handle.areas();
    let given = Area::read(words, len);
    // SAFETY: as above.
    if let Err(status) = unsafe { report_area(report, &[workspace, image, given]) } {
        return status;
    }
    let mut take_in = || -> Result<(), Refusal> {
        apart(&[workspace, given])?;
        // SAFETY: as above.
        let words = unsafe { read(words, len) }?;
        handle.guarded.set_instruction(Instruction::Words(words))?;
        Ok(())
    };
    let result = take_in();
    // SAFETY: as above.
    unsafe { told(result, report) }
}

/// Finds the known instruction that a sentence, given as word embeddings, is most similar to, and
/// its similarity, from -1 to 1. A program that accepts free sentences compares the similarity with
/// the contract's `acceptance` and refuses sentences below: the policy follows any words. Words are
/// compared, not meanings. `number` may be null.
///
/// # Safety
/// `policy` is null or a `lads_policy`, zeroed or opened; `words` points to `len` readable elements; `number` is null or may be
/// written, `similarity` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_instruction_similarity(
    policy: *const LadsPolicy,
    words: *const f32,
    len: usize,
    number: *mut u32,
    similarity: *mut f32,
) -> Status {
    // SAFETY: the caller guarantees all of it.
    status(unsafe { nearest(policy, words, len, number, similarity) })
}

/// Finds the known instruction that words are most similar to.
///
/// # Safety
/// The conditions of [`lads_instruction_similarity`] hold.
unsafe fn nearest(
    policy_at: *const LadsPolicy,
    words: *const f32,
    len: usize,
    number: *mut u32,
    to: *mut f32,
) -> Result<(), Status> {
    // SAFETY: the caller guarantees the policy.
    let policy = unsafe { handle::policy(policy_at) }?;
    check(to, 1)?;
    if !number.is_aligned() {
        return Err(Status::Misaligned);
    }
    let [policy_area, image] = areas_of(policy_at, policy);
    apart(&[
        policy_area,
        image,
        Area::read(words, len),
        Area::written(number, 1),
        Area::written(to, 1),
    ])?;
    let contract = policy.contract();
    if contract.instruction_channel().is_none() {
        return Err(Status::NoInstructionTaken);
    }
    // SAFETY: the caller guarantees the words.
    let words = unsafe { read(words, len) }?;
    let dim = contract.word_dim();
    if words.is_empty() || words.len().checked_rem(dim) != Some(0) {
        return Err(Status::WordsLength);
    }
    if !words.iter().all(|x| x.is_finite()) {
        return Err(Status::WordsNotFinite);
    }
    let known = contract.instructions().map(|known| known.words);
    let (place, alike) =
        similarity::nearest(words, known, dim).ok_or(Status::UnknownInstruction)?;
    // SAFETY: not null, or not written, and aligned, as was checked; the caller guarantees the memory.
    unsafe {
        to.write(alike);
        if !number.is_null() {
            number.write(place as u32);
        }
    }
    Ok(())
}

/// Sets how indices are picked: by argmax (`temperature` not above 0) or at random with the softmax
/// of the scores over the temperature.
///
/// # Safety
/// The conditions of `lads_self_test` hold.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_set_decision(
    controller: *mut LadsController,
    temperature: f32,
    seed: u64,
) -> Status {
    let rule = if temperature > 0.0 {
        Decision::Sample { temperature, seed }
    } else {
        Decision::Argmax
    };
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.map(|handle| handle.guarded.set_decision(rule)))
}

/// Sets the source of a policy's noise: `LADS_NOISE_ZERO`, or `LADS_NOISE_SEEDED` with a seed,
/// whose generator starts again.
///
/// # Safety
/// The conditions of `lads_self_test` hold.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_set_noise(
    controller: *mut LadsController,
    rule: u32,
    seed: u64,
) -> Status {
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.and_then(|handle| {
        handle.guarded.set_noise(match rule {
            LADS_NOISE_ZERO => Noise::Zero,
            LADS_NOISE_SEEDED => Noise::Seeded { seed },
            _ => return Err(Status::UnknownOption),
        });
        Ok(())
    }))
}
