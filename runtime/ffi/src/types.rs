//! What C sees: structs of plain numbers and pointers.

use core::ffi::c_char;
use core::{ptr, slice};

use lads_core::{Counters, Element, GuardReport, KnownInstruction, Policy, SelfTest};

use crate::status::Status;

/// Words of a `lads_policy`.
pub const LADS_POLICY_WORDS: usize = 96;

/// An open policy: a checked view on a program image, in memory of the caller. Its content is private; it may not be moved or
/// copied after it was opened, and the image has to stay where it is, unchanged, as long as the policy is used.
#[repr(C)]
pub struct LadsPolicy {
    /// Private.
    pub private_words: [u64; LADS_POLICY_WORDS],
}

/// A controller with its guard, at the start of its workspace. Private.
pub struct LadsController {
    _private: [u8; 0],
}

/// Characters in UTF-8, without a zero at the end: print them with "%.*s", (int)text.len, text.data.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsText {
    /// The first character; never null.
    pub data: *const c_char,
    /// Bytes.
    pub len: usize,
}

impl LadsText {
    pub(crate) fn new(text: &str) -> Self {
        Self {
            data: text.as_ptr().cast(),
            len: text.len(),
        }
    }

    /// The text, as long as what it points into lives.
    ///
    /// # Safety
    /// The data are those of a text that lives during `'a`.
    pub unsafe fn as_str<'a>(self) -> &'a str {
        // SAFETY: the caller guarantees it.
        let bytes = unsafe { slice::from_raw_parts(self.data.cast(), self.len) };
        str::from_utf8(bytes).unwrap_or_default()
    }
}

/// What a policy expects and promises.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsContract {
    /// Environment, for example "franka-kitchen".
    pub environment: LadsText,
    /// The environment's version.
    pub environment_version: LadsText,
    /// SHA-256 of the bundle that the image was compiled from, hexadecimal.
    pub bundle_sha256: LadsText,
    /// Language encoder that made the word embeddings.
    pub encoder: LadsText,
    /// SHA-256 of its weights, hexadecimal.
    pub encoder_sha256: LadsText,
    /// Time from one control step to the next, in seconds.
    pub control_period_s: f32,
    /// Control steps from one decision to the next.
    pub horizon: u32,
    /// Entries of the codebook, that is, plans.
    pub codebook_len: u32,
    /// Elements of an observation.
    pub observation_len: usize,
    /// Elements of an action.
    pub action_len: usize,
    /// The most words of an instruction.
    pub words_len: usize,
    /// Elements of a word embedding.
    pub word_dim: usize,
    /// Instructions that the policy knows by number.
    pub instruction_count: u32,
    /// Control steps that a context holds.
    pub context_steps: u32,
    /// Bytes of the image; what lies behind them is not read.
    pub image_bytes: usize,
}

impl LadsContract {
    pub(crate) fn of(policy: &Policy<'static>) -> Self {
        let contract = policy.contract();
        Self {
            environment: LadsText::new(contract.environment_id()),
            environment_version: LadsText::new(contract.environment_version()),
            bundle_sha256: LadsText::new(contract.bundle_sha256()),
            encoder: LadsText::new(contract.encoder()),
            encoder_sha256: LadsText::new(contract.encoder_sha256()),
            control_period_s: contract.control_period_s(),
            horizon: contract.horizon() as u32,
            codebook_len: contract.codebook_len() as u32,
            observation_len: contract.observation_len(),
            action_len: contract.action_len(),
            words_len: contract.words_len(),
            word_dim: contract.word_dim(),
            instruction_count: contract.instruction_count() as u32,
            context_steps: contract.context_steps() as u32,
            image_bytes: policy.image_bytes(),
        }
    }
}

/// One element of an observation or an action.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsElement {
    /// Name.
    pub name: LadsText,
    /// Unit, "1" for none.
    pub unit: LadsText,
    /// Joint that it belongs to; empty for none.
    pub joint: LadsText,
    /// Smallest value, in the unit.
    pub min: f32,
    /// Largest value, in the unit.
    pub max: f32,
}

impl LadsElement {
    pub(crate) fn new(element: &Element<'static>) -> Self {
        Self {
            name: LadsText::new(element.name),
            unit: LadsText::new(element.unit),
            joint: LadsText::new(element.joint),
            min: element.limits.min,
            max: element.limits.max,
        }
    }
}

/// One instruction that a policy knows.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsInstruction {
    /// Short name.
    pub id: LadsText,
    /// What the person says.
    pub text: LadsText,
    /// Sub-tasks, separated by commas.
    pub sub_tasks: LadsText,
    /// Words.
    pub words_len: usize,
}

impl LadsInstruction {
    pub(crate) fn new(known: &KnownInstruction<'static>, word_dim: usize) -> Self {
        Self {
            id: LadsText::new(known.id),
            text: LadsText::new(known.text),
            sub_tasks: LadsText::new(known.sub_tasks),
            words_len: known.words.len().checked_div(word_dim).unwrap_or(0),
        }
    }
}

/// Flag: arm when the controller is set up, without a self-test. Whoever sets it vouches for the policy on this machine.
pub const LADS_ARM_WITHOUT_SELF_TEST: u32 = 1;

/// Flag: run the same machine code on every processor of the target instead of the widest instructions that this one has.
/// The results have the same bits.
pub const LADS_PORTABLE_INSTRUCTIONS: u32 = 2;

/// Fallback: to the safe action, and stay there until `lads_resume`.
pub const LADS_FALLBACK_STOP: u32 = 0;

/// Fallback: the last action again.
pub const LADS_FALLBACK_HOLD: u32 = 1;

/// Fallback: towards the safe action with the time constant `decay_s`.
pub const LADS_FALLBACK_DECAY: u32 = 2;

/// How the guard works. All zero (`lads_options options = {0};`) is a guard with the contract's limits and no rate that stops at
/// the first fault. The lists have `action_len` elements and are copied; null stands for the default.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsOptions {
    /// `LADS_ARM_WITHOUT_SELF_TEST`, `LADS_PORTABLE_INSTRUCTIONS`, or both.
    pub flags: u32,
    /// What to do when the policy's action cannot be used: `LADS_FALLBACK_STOP`, `_HOLD` or `_DECAY`.
    pub fallback: u32,
    /// Time constant of the decay, in seconds.
    pub decay_s: f32,
    /// Missed control periods that are still tolerated between two steps.
    pub late_after: u32,
    /// Stops after so many interventions in a row; 0 for never.
    pub stop_after: u32,
    /// Smallest actions, where the contract's are not narrower.
    pub min: *const f32,
    /// Largest actions, where the contract's are not narrower.
    pub max: *const f32,
    /// Largest change, in units of the action per second.
    pub max_rate: *const f32,
    /// Where the stop and the decay lead, and where the first action starts from.
    pub safe_action: *const f32,
}

impl Default for LadsOptions {
    fn default() -> Self {
        Self {
            flags: 0,
            fallback: LADS_FALLBACK_STOP,
            decay_s: 0.0,
            late_after: 0,
            stop_after: 0,
            min: ptr::null(),
            max: ptr::null(),
            max_rate: ptr::null(),
            safe_action: ptr::null(),
        }
    }
}

/// The clock of one control period.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct LadsTick {
    /// When the observation was taken, in any unit. One that is not later than the last one is stale.
    pub timestamp: u64,
    /// Control periods that have passed without a step since the last one.
    pub missed: u32,
}

/// What happened in a control period.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C)]
pub struct LadsReport {
    /// What `lads_step` returned.
    pub status: i32,
    /// 1 when the policy took a step; the next four are 0 otherwise.
    pub stepped: u32,
    /// Control steps since the context began.
    pub timestep: u32,
    /// The plan in force: an index into the codebook.
    pub plan: u32,
    /// 1 when this step decided the plan, else 0.
    pub decided: u32,
    /// The largest logit of the last decision minus the second largest.
    pub margin: f32,
    /// 1 when an element of the action was at a limit or beyond and is now at the limit.
    pub saturated: u32,
    /// 1 when an element of the action moves as fast as it may, less far than it should.
    pub rate_limited: u32,
}

impl LadsReport {
    pub(crate) fn new(status: Status, report: &GuardReport) -> Self {
        let step = report.step;
        Self {
            status: status as i32,
            stepped: u32::from(step.is_some()),
            timestep: step.map_or(0, |step| step.timestep),
            plan: step.map_or(0, |step| step.plan.0),
            decided: u32::from(step.is_some_and(|step| step.decided)),
            margin: step.map_or(0.0, |step| step.margin),
            saturated: u32::from(report.saturated),
            rate_limited: u32::from(report.rate_limited),
        }
    }
}

/// What a self-test that passed has measured.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C)]
pub struct LadsSelfTest {
    /// Control steps replayed.
    pub steps: u32,
    /// FNV-1a, of 32 bits, over the bits of all actions, as little-endian bytes: two targets with the same digest computed the same
    /// bits.
    pub digest: u32,
    /// Largest absolute difference of an action element from the recorded one.
    pub largest_error: f32,
}

impl From<SelfTest> for LadsSelfTest {
    fn from(passed: SelfTest) -> Self {
        let SelfTest {
            steps,
            largest_error,
            digest,
        } = passed;
        Self {
            steps,
            digest,
            largest_error,
        }
    }
}

/// What a guard has done since the controller was set up, in control periods. `policy` to `refused` add up to `periods`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(C)]
pub struct LadsCounters {
    /// All.
    pub periods: u64,
    /// With the policy's action.
    pub policy: u64,
    /// Before arming.
    pub not_armed: u64,
    /// While stopped.
    pub stopped: u64,
    /// Without an observation.
    pub no_observation: u64,
    /// With a stale observation.
    pub stale: u64,
    /// In which too many periods had been missed.
    pub late: u64,
    /// With an observation that was not finite.
    pub not_finite: u64,
    /// With an observation outside the contract's limits.
    pub out_of_limits: u64,
    /// That the controller refused for another reason: no instruction, a full context, a wrong length.
    pub refused: u64,
    /// Missed periods.
    pub missed: u64,
    /// With an action at a limit.
    pub saturated: u64,
    /// With an action that the rate held back.
    pub rate_limited: u64,
}

impl From<Counters> for LadsCounters {
    fn from(counters: Counters) -> Self {
        let Counters {
            periods,
            policy,
            not_armed,
            stopped,
            no_observation,
            stale,
            late,
            missed,
            not_finite,
            out_of_limits,
            refused,
            saturated,
            rate_limited,
        } = counters;
        Self {
            periods,
            policy,
            not_armed,
            stopped,
            no_observation,
            stale,
            late,
            not_finite,
            out_of_limits,
            refused,
            missed,
            saturated,
            rate_limited,
        }
    }
}
