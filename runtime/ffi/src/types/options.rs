//! Inputs of a caller besides the policy: the guard's options, the clock, the values of channels.

use core::ffi::c_void;
use core::ptr;

use crate::versioned::versioned;

/// Flag that arms the controller when it is set up, without a self-test. The caller who sets it
/// vouches for the policy on this machine.
pub const LADS_ARM_WITHOUT_SELF_TEST: u32 = 1;

/// Flag that runs the same machine code on every processor of the target instead of the widest
/// instruction set of this one. The results have the same bits.
pub const LADS_PORTABLE_INSTRUCTIONS: u32 = 2;

/// Fallback that moves to the safe action and stays there until `lads_resume`.
pub const LADS_FALLBACK_STOP: u32 = 0;

/// Fallback that repeats the last action.
pub const LADS_FALLBACK_HOLD: u32 = 1;

/// Fallback that moves towards the safe action with the time constant `decay_s`.
pub const LADS_FALLBACK_DECAY: u32 = 2;

/// Noise of zeros, the mean of the standard normal distribution.
pub const LADS_NOISE_ZERO: u32 = 0;

/// Noise of standard normal numbers; the same seed gives the same values on every target.
pub const LADS_NOISE_SEEDED: u32 = 1;

/// Options of a controller and its guard. All zero but the size
/// (`lads_options options = {sizeof options};`) means a guard with the contract's limits and no
/// rate limit that stops at the first fault. The lists have `action_len` elements and are copied;
/// null means the default.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsOptions {
    /// Size of the struct: set it to `sizeof(lads_options)`.
    pub struct_bytes: u32,
    /// Flags: `LADS_ARM_WITHOUT_SELF_TEST`, `LADS_PORTABLE_INSTRUCTIONS`, or both.
    pub flags: u32,
    /// Action to write when the policy's action cannot be used: `LADS_FALLBACK_STOP`, `_HOLD` or
    /// `_DECAY`.
    pub fallback: u32,
    /// Time constant of the decay, in seconds.
    pub decay_s: f32,
    /// Number of missed control periods between two steps that is still tolerated.
    pub late_after: u32,
    /// Number of periods in a row whose observation is missing, stale or refused, in which the last
    /// action is repeated and the policy's state is kept before the fallback takes over.
    pub coast: u32,
    /// Number of interventions in a row after which the guard stops; 0 for never.
    pub stop_after: u32,
    /// Largest step from the last timestamp to the next, in its unit, such as ten control periods;
    /// 0 for any, so that one corrupt timestamp makes all later ones stale until `lads_reset`. A
    /// timestamp further ahead is considered corrupt: it is refused, and does not become the last
    /// one, until the next one follows on it within the bound: then the time has really passed. Of
    /// the first two of an episode either may be the corrupt one: the next timestamp is measured
    /// from the second.
    pub max_jump: u64,
    /// Smallest actions; the contract's apply where they are narrower.
    pub min: *const f32,
    /// Largest actions; the contract's apply where they are narrower.
    pub max: *const f32,
    /// Largest change, in units of the action per second; unlimited if null.
    pub max_rate: *const f32,
    /// Action to which the stop and the decay lead, and from which the first action starts; if
    /// null, zero or the limit nearest to it.
    pub safe_action: *const f32,
}

impl Default for LadsOptions {
    fn default() -> Self {
        Self {
            struct_bytes: size_of::<Self>() as u32,
            flags: 0,
            fallback: LADS_FALLBACK_STOP,
            decay_s: 0.0,
            late_after: 0,
            coast: 0,
            stop_after: 0,
            max_jump: 0,
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
    /// Size of the struct: set it to `sizeof(lads_tick)`.
    pub struct_bytes: u32,
    /// Number of control periods that have passed without a step since the last one.
    pub missed: u32,
    /// Time at which the observation was taken, in any unit. An observation that is not later than
    /// the last one is stale.
    pub timestamp: u64,
}

impl Default for LadsTick {
    fn default() -> Self {
        Self {
            struct_bytes: size_of::<Self>() as u32,
            missed: 0,
            timestamp: 0,
        }
    }
}

/// The values of one channel. It has no `struct_bytes`, as it comes in lists; it will not grow.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsInput {
    /// Number of the channel.
    pub channel: u32,
    /// Type of the values, which is the channel's: `LADS_F32`, `LADS_U8` or `LADS_I32`.
    pub dtype: u32,
    /// Pointer to the values, contiguous and in the order of the channel's axes. Null means that
    /// there is no observation.
    pub data: *const c_void,
    /// Number of values.
    pub len: usize,
    /// Bytes from one row to the next, where the first axis counts rows, such as the lines of an
    /// image. A line that is longer than its pixels is refused (`LADS_STATUS_CHANNEL_ROWS`), as the
    /// library has no memory to pack lines into: copy them first. 0 means that there is no gap.
    pub row_bytes: usize,
}

versioned!(LadsOptions, LadsTick);
