//! What a caller gives besides the policy: how the guard works, the clock, the values of channels.

use core::ffi::c_void;
use core::ptr;

use crate::versioned::versioned;

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

/// Noise: zeros, the mean of what would be drawn.
pub const LADS_NOISE_ZERO: u32 = 0;

/// Noise: standard normals; the same seed gives the same values on every target.
pub const LADS_NOISE_SEEDED: u32 = 1;

/// How the guard works. All zero but the size (`lads_options options = {sizeof options};`) is a guard with the contract's limits and
/// no rate that stops at the first fault. The lists have `action_len` elements and are copied; null stands for the default.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct LadsOptions {
    /// Set to `sizeof(lads_options)`.
    pub struct_bytes: u32,
    /// `LADS_ARM_WITHOUT_SELF_TEST`, `LADS_PORTABLE_INSTRUCTIONS`, or both.
    pub flags: u32,
    /// What to do when the policy's action cannot be used: `LADS_FALLBACK_STOP`, `_HOLD` or `_DECAY`.
    pub fallback: u32,
    /// Time constant of the decay, in seconds.
    pub decay_s: f32,
    /// Missed control periods that are still tolerated between two steps.
    pub late_after: u32,
    /// Periods in a row whose observation is missing, stale or refused, in which the last action is repeated and the policy's state is
    /// kept before the fallback takes over.
    pub coast: u32,
    /// Stops after so many interventions in a row; 0 for never.
    pub stop_after: u32,
    /// The farthest that a timestamp may lie behind the last one, in its unit; 0 for any distance. One beyond it is taken for damaged:
    /// it is refused, and does not count as the last one.
    pub max_jump: u64,
    /// Smallest actions, where the contract's are not narrower.
    pub min: *const f32,
    /// Largest actions, where the contract's are not narrower.
    pub max: *const f32,
    /// Largest change, in units of the action per second.
    pub max_rate: *const f32,
    /// Where the stop and the decay lead, and where the first action starts from; zero, or the limit nearest to it, unless given.
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
    /// Set to `sizeof(lads_tick)`.
    pub struct_bytes: u32,
    /// Control periods that have passed without a step since the last one.
    pub missed: u32,
    /// When the observation was taken, in any unit. One that is not later than the last one is stale.
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
    /// Type of the values, the channel's: `LADS_F32`, `LADS_U8` or `LADS_I32`.
    pub dtype: u32,
    /// The values, one behind the other in the order of the channel's axes. Null says that there is no observation.
    pub data: *const c_void,
    /// How many values there are.
    pub len: usize,
    /// Bytes from one row to the next, a row being what the first axis counts, such as a line of an image: whoever takes pictures
    /// knows it. A line that is longer than its pixels is refused (`LADS_STATUS_CHANNEL_ROWS`), as the library has no memory to
    /// bring lines together in: copy them first. 0 says that there is no gap.
    pub row_bytes: usize,
}

versioned!(LadsOptions, LadsTick);
