//! Steps the controller: one control period writes an action that may be executed wherever there is
//! room for one, whatever else is wrong.

use lads_core::{ChannelId, Data, GuardReport, InputError, MAX_OBSERVATIONS, Policy, Tick};

use crate::handle::{self, Handle};
use crate::memory::{Area, apart, apart_from, check, read, zeroed};
use crate::status::Status;
use crate::types::{
    LADS_F32, LADS_I32, LADS_U8, LadsController, LadsInput, LadsReport, LadsTick, Refusal,
};
use crate::versioned;

/// Largest number of channels that a control step can take: all observations and the noise.
const MOST: usize = MAX_OBSERVATIONS + 1;

/// Runs one control period of a policy with one observation channel of floats: writes an action
/// that is finite and inside limits and rates, whatever the observation is. `LADS_STATUS_OK` means
/// that it is the policy's action; any other status states why it is the fallback's. A null
/// `observation` means that there is none. `tick` may be null, then nothing is stale or late; so
/// may `report`, which names the channel and the element that was refused.
///
/// Nothing is written, and no period is counted, only where there is no room for an action:
/// `controller` is null, misaligned or not set up; `action` is null, misaligned, of another length
/// than the contract's, or overlaps the workspace or the image. Any other fault of the call, such
/// as a `tick` or a `report` that is misaligned, has no size or overlaps, makes it a period without
/// an observation: the fallback's action is written, the status states the fault, and so does the
/// report unless it is at fault.
///
/// # Safety
/// The conditions of `lads_self_test` hold; `observation` and `action` point to as many elements as they say; `tick` and `report` are null or may
/// be read, and the report written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_step(
    controller: *mut LadsController,
    observation: *const f32,
    observation_len: usize,
    tick: *const LadsTick,
    action: *mut f32,
    action_len: usize,
    report: *mut LadsReport,
) -> Status {
    let given = Vector {
        data: observation,
        len: observation_len,
    };
    let frame = Frame {
        controller,
        tick,
        action,
        action_len,
        report,
    };
    // SAFETY: the caller guarantees all of it.
    unsafe { frame.period(&given) }
}

/// Runs one control period of any policy, like `lads_step`: `inputs` are the values of all
/// observation channels, in any order; a null pointer means that there is no observation. Values
/// for a noise channel, as many as the contract's `noise_len` in the order in which they are used,
/// take the place of the library's.
///
/// # Safety
/// The conditions of `lads_step` hold; `inputs` points to `count` inputs, whose data are as many values of their type as they say.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_step_channels(
    controller: *mut LadsController,
    inputs: *const LadsInput,
    count: usize,
    tick: *const LadsTick,
    action: *mut f32,
    action_len: usize,
    report: *mut LadsReport,
) -> Status {
    let given = Channels { inputs, count };
    let frame = Frame {
        controller,
        tick,
        action,
        action_len,
        report,
    };
    // SAFETY: the caller guarantees all of it.
    unsafe { frame.period(&given) }
}

/// Arguments of every step besides the observation.
struct Frame {
    controller: *mut LadsController,
    tick: *const LadsTick,
    action: *mut f32,
    action_len: usize,
    report: *mut LadsReport,
}

/// An observation in C's form.
trait Observation {
    /// Refuses values that overlap memory that the call writes.
    ///
    /// # Safety
    /// The observation is as [`lads_step`] or [`lads_step_channels`] asks.
    unsafe fn apart_from(&self, written: &[Area]) -> Result<(), Status>;

    /// Takes a step with the observation.
    ///
    /// # Safety
    /// The conditions of [`apart_from`](Self::apart_from) hold, and it has returned `Ok`.
    unsafe fn step(
        &self,
        handle: &mut Handle,
        tick: Option<Tick>,
        action: &mut [f32],
    ) -> Result<GuardReport, Refusal>;
}

impl Frame {
    /// Runs one control period with an observation.
    ///
    /// # Safety
    /// The conditions of [`lads_step`] hold.
    unsafe fn period(&self, given: &impl Observation) -> Status {
        // SAFETY: the caller guarantees the controller.
        let handle = match unsafe { handle::handle(self.controller) } {
            Ok(handle) => handle,
            Err(status) => return status,
        };
        if let Err(status) = self.room(handle) {
            return status;
        }
        let [workspace, image] = handle.areas();
        let written = [workspace, Area::written(self.action, self.action_len)];
        // SAFETY: the caller guarantees the report, the clock and the observation.
        let (reported, clock, observed) = unsafe {
            (
                self.reported(&[written[0], written[1], image], given),
                self.clock(&written),
                given.apart_from(&written),
            )
        };
        // SAFETY: it was checked; the caller guarantees the memory.
        let action = unsafe { zeroed(self.action, self.action_len) }.unwrap_or_default();
        let made = match (reported, clock, observed) {
            // SAFETY: the observation is apart from what is written, and the caller guarantees it.
            (Ok(()), Ok(tick), Ok(())) => unsafe { given.step(handle, tick, action) },
            (Err(status), ..) | (_, Err(status), _) | (.., Err(status)) => Err(status.into()),
        };
        let missed = clock.ok().flatten().map_or(0, |tick| tick.missed);
        let (refusal, made) = match made {
            Ok(made) => (
                made.intervention.map_or(Status::Ok.into(), Refusal::from),
                made,
            ),
            Err(refusal) => {
                let Ok(blind) = handle.guarded.step_blind_after(missed, action) else {
                    return Status::ActionLength;
                };
                // Whether there is an observation does not matter before arming and after a stop; what is wrong with the call does.
                let why = blind.intervention.map_or(refusal, Refusal::from);
                let nothing = refusal.status == Status::NoObservation;
                (if nothing { why } else { refusal }, blind)
            }
        };
        if reported.is_ok() && !self.report.is_null() {
            let report = LadsReport::of(refusal.status, &made, &refusal);
            // SAFETY: it was checked; the caller guarantees that it may be written.
            let _ = unsafe { versioned::write(self.report, &report) };
        }
        refusal.status
    }

    /// Checks whether an action can be written.
    fn room(&self, handle: &Handle) -> Result<(), Status> {
        check(self.action, self.action_len)?;
        if self.action_len != handle.guarded.controller().policy().contract().action_len() {
            return Err(Status::ActionLength);
        }
        apart_from(
            &Area::written(self.action, self.action_len),
            &handle.areas(),
        )
    }

    /// Checks whether a report can be written, without overlap with anything that the call reads or
    /// writes.
    ///
    /// # Safety
    /// The conditions of [`lads_step`] hold.
    unsafe fn reported(&self, others: &[Area], given: &impl Observation) -> Result<(), Status> {
        // SAFETY: the caller guarantees all of it.
        unsafe {
            let report = versioned::write_area(self.report)?;
            apart_from(&report, others)?;
            apart(&[report, Area::read(self.tick, 1)])?;
            // A null observation, or one with something else wrong, is not the report's fault.
            match given.apart_from(&[report]) {
                Err(Status::Overlap) => Err(Status::Overlap),
                _ => Ok(()),
            }
        }
    }

    /// Reads the clock of the period.
    ///
    /// # Safety
    /// The conditions of [`lads_step`] hold.
    unsafe fn clock(&self, written: &[Area]) -> Result<Option<Tick>, Status> {
        if self.tick.is_null() {
            return Ok(None);
        }
        // SAFETY: the caller guarantees the clock.
        let LadsTick {
            timestamp, missed, ..
        } = unsafe {
            apart_from(&versioned::read_area(self.tick)?, written)?;
            versioned::read(self.tick)?
        };
        Ok(Some(Tick { timestamp, missed }))
    }
}

/// Values of the only observation channel.
struct Vector {
    data: *const f32,
    len: usize,
}

impl Observation for Vector {
    unsafe fn apart_from(&self, written: &[Area]) -> Result<(), Status> {
        if self.data.is_null() {
            return Err(Status::NoObservation);
        }
        if self.len > 0 {
            check(self.data, self.len)?;
        }
        apart_from(&Area::read(self.data, self.len), written)
    }

    unsafe fn step(
        &self,
        handle: &mut Handle,
        tick: Option<Tick>,
        action: &mut [f32],
    ) -> Result<GuardReport, Refusal> {
        // SAFETY: the caller guarantees the observation.
        let observation = unsafe { read(self.data, self.len) }?;
        let made = handle.guarded.step(observation, tick, action);
        made.map_err(|_| Status::ActionLength.into())
    }
}

/// Values of any channels.
struct Channels {
    inputs: *const LadsInput,
    count: usize,
}

impl Channels {
    /// Returns the inputs of the call.
    ///
    /// # Safety
    /// The conditions of [`lads_step_channels`] hold.
    unsafe fn all<'a>(&self) -> Result<&'a [LadsInput], Status> {
        if self.inputs.is_null() {
            return Err(Status::NoObservation);
        }
        // SAFETY: the caller guarantees the list.
        unsafe { read(self.inputs, self.count) }
    }
}

impl Observation for Channels {
    unsafe fn apart_from(&self, written: &[Area]) -> Result<(), Status> {
        apart_from(&Area::read(self.inputs, self.count), written)?;
        // SAFETY: the caller guarantees the list.
        for input in unsafe { self.all() }? {
            let bytes = bytes_of(input.dtype).saturating_mul(input.len);
            apart_from(&Area::read(input.data.cast::<u8>(), bytes), written)?;
        }
        Ok(())
    }

    unsafe fn step(
        &self,
        handle: &mut Handle,
        tick: Option<Tick>,
        action: &mut [f32],
    ) -> Result<GuardReport, Refusal> {
        let mut given = [(ChannelId(0), Data::F32(&[])); MOST];
        // SAFETY: the caller guarantees the list.
        let inputs = unsafe { self.all() }?;
        if let Some(beyond) = inputs.get(MOST) {
            // More than there can be: one is given twice, or is not a channel of a step.
            let channel = beyond.channel;
            return Err(InputError::Unknown { channel }.into());
        }
        let policy = handle.guarded.controller().policy();
        for (input, to) in inputs.iter().zip(&mut given) {
            // SAFETY: the caller guarantees the values.
            let data = unsafe { values(input, policy) };
            let refused = |status| Refusal::in_channel(status, input.channel);
            *to = (ChannelId(input.channel), data.map_err(refused)?);
        }
        let given = given.get(..inputs.len()).unwrap_or(&given);
        let made = handle.guarded.step_with(given, tick, action);
        made.map_err(|_| Status::ActionLength.into())
    }
}

/// Returns the size of one value in bytes.
fn bytes_of(dtype: u32) -> usize {
    if dtype == LADS_U8 { 1 } else { 4 }
}

/// Returns the values of one channel, which have to be contiguous.
///
/// # Safety
/// The input's data are as many values of its type as it says.
unsafe fn values<'a>(input: &LadsInput, policy: &Policy) -> Result<Data<'a>, Status> {
    let LadsInput {
        channel,
        dtype,
        data,
        len,
        row_bytes,
    } = *input;
    if data.is_null() {
        return Err(Status::NoObservation);
    }
    let rows = policy.contract().channel(ChannelId(channel));
    let rows = rows.and_then(|channel| channel.shape().first().copied());
    let row = rows.and_then(|rows| len.checked_div(rows as usize));
    // How long the rows of an unknown channel are does not matter.
    let gap = row.is_some_and(|row| row.saturating_mul(bytes_of(dtype)) != row_bytes);
    if row_bytes != 0 && gap {
        return Err(Status::ChannelRows);
    }
    // SAFETY: the caller guarantees the values.
    unsafe {
        Ok(match dtype {
            LADS_F32 => Data::F32(read(data.cast(), len)?),
            LADS_U8 => Data::U8(read(data.cast(), len)?),
            LADS_I32 => Data::I32(read(data.cast(), len)?),
            _ => return Err(Status::ChannelType),
        })
    }
}
