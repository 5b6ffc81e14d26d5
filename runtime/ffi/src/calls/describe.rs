//! Opens a policy and describes it.

use core::ffi::c_char;

use lads_core::{Channel, ChannelId, Contract, Policy};

use super::status;
use crate::handle::{self, areas_of};
use crate::memory::{Area, apart, check, read};
use crate::status::Status;
use crate::types::{LadsChannel, LadsContract, LadsElement, LadsInstruction, LadsPolicy};
use crate::versioned::{self, Versioned};

/// Opens a program image: checks all of it, its checksum included, and copies nothing. The image is
/// aligned to 4 bytes (64 is better); bytes after its own length are ignored. After a failure
/// `policy` holds no policy.
///
/// # Safety
/// `image` points to `image_bytes` readable bytes that do not change as long as the policy or a controller of it is used;
/// `policy` may be written, and stays where it is.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_policy_open(
    image: *const u8,
    image_bytes: usize,
    policy: *mut LadsPolicy,
) -> Status {
    // SAFETY: the caller guarantees both.
    unsafe { lads_policy_open_within(image, image_bytes, Policy::WORK_LIMIT, policy) }
}

/// Opens a program image, like `lads_policy_open`, but refuses one whose most expensive control
/// step takes more than `work_limit` multiply-adds; `lads_policy_open` refuses images that take
/// some seconds on a fast core.
///
/// # Safety
/// The conditions of `lads_policy_open` hold.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_policy_open_within(
    image: *const u8,
    image_bytes: usize,
    work_limit: u64,
    policy: *mut LadsPolicy,
) -> Status {
    // SAFETY: the caller guarantees both.
    status(unsafe { handle::open(image, image_bytes, work_limit, policy) })
}

/// Writes the record that `find` finds in the contract.
///
/// # Safety
/// The conditions of `lads_policy_contract` hold.
unsafe fn tell<T: Versioned>(
    policy_at: *const LadsPolicy,
    to: *mut T,
    find: impl FnOnce(&Policy<'static>) -> Result<T, Status>,
) -> Result<(), Status> {
    // SAFETY: the caller guarantees both.
    let policy = unsafe { handle::policy(policy_at) }?;
    let found = find(policy)?;
    if to.is_null() {
        return Err(Status::Null);
    }
    let [policy_area, image] = areas_of(policy_at, policy);
    // SAFETY: as above.
    let area = unsafe { versioned::write_area(to) }?;
    apart(&[policy_area, image, area])?;
    // SAFETY: as above.
    unsafe { versioned::write(to, &found) }
}

/// Writes the number that belongs to a name.
///
/// # Safety
/// `name` points to `name_len` bytes, `number` may be written, and the policy meets the conditions of `lads_policy_contract`.
unsafe fn find(
    policy_at: *const LadsPolicy,
    name: *const c_char,
    name_len: usize,
    number: *mut u32,
    find: impl FnOnce(&Contract<'static>, &[u8]) -> Result<u32, Status>,
) -> Result<(), Status> {
    // SAFETY: the caller guarantees all three.
    let policy = unsafe { handle::policy(policy_at) }?;
    check(number, 1)?;
    let [policy_area, image] = areas_of(policy_at, policy);
    apart(&[
        policy_area,
        image,
        Area::read(name, name_len),
        Area::written(number, 1),
    ])?;
    // SAFETY: as above.
    let found = find(policy.contract(), unsafe {
        read(name.cast::<u8>(), name_len)
    }?)?;
    // SAFETY: not null and aligned, as was checked; the caller guarantees that it may be written.
    unsafe { number.write(found) };
    Ok(())
}

/// Compares byte by byte: comparing slices would call `bcmp`, which not every C library has.
fn same(text: &str, name: &[u8]) -> bool {
    text.bytes().eq(name.iter().copied())
}

fn channel_of<'a>(contract: &Contract<'a>, number: u32) -> Result<Channel<'a>, Status> {
    contract.channel(ChannelId(number)).ok_or(Status::NoChannel)
}

/// Writes the contract of a policy: its sizes, numbers of channels and texts. The texts live as
/// long as the image.
///
/// # Safety
/// `policy` is null or a `lads_policy`, zeroed or opened; `contract` may be read and written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_policy_contract(
    policy: *const LadsPolicy,
    contract: *mut LadsContract,
) -> Status {
    // SAFETY: the caller guarantees both.
    status(unsafe { tell(policy, contract, |policy| Ok(LadsContract::of(policy))) })
}

/// Returns the number of channels of a policy; 0 if it was not opened.
///
/// # Safety
/// `policy` is null or a `lads_policy`, zeroed or opened.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_channel_count(policy: *const LadsPolicy) -> u32 {
    // SAFETY: the caller guarantees it.
    unsafe { handle::policy(policy) }
        .map_or(0, |policy| policy.contract().channels().count() as u32)
}

/// Writes the description of a channel, by its number from 0.
///
/// # Safety
/// The conditions of `lads_policy_contract` hold.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_channel(
    policy: *const LadsPolicy,
    number: u32,
    channel: *mut LadsChannel,
) -> Status {
    // SAFETY: the caller guarantees both.
    status(unsafe {
        tell(policy, channel, |policy| {
            let found = channel_of(policy.contract(), number)?;
            Ok(LadsChannel::new(&found))
        })
    })
}

/// Finds the number of a channel by its name, byte for byte.
///
/// # Safety
/// The conditions of `lads_policy_contract` hold; `name` points to `name_len` bytes, no zero needed; `number` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_channel_find(
    policy: *const LadsPolicy,
    name: *const c_char,
    name_len: usize,
    number: *mut u32,
) -> Status {
    // SAFETY: the caller guarantees all three.
    status(unsafe {
        find(policy, name, name_len, number, |contract, name| {
            let found = contract
                .channels()
                .find(|channel| same(channel.name(), name));
            found.map(|channel| channel.id().0).ok_or(Status::NoChannel)
        })
    })
}

/// Writes the description of an element of a channel: name, unit, limits, joint, interface, and the
/// meaning of its values.
///
/// # Safety
/// The conditions of `lads_policy_contract` hold.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_channel_element(
    policy: *const LadsPolicy,
    channel: u32,
    index: usize,
    element: *mut LadsElement,
) -> Status {
    // SAFETY: the caller guarantees both.
    status(unsafe {
        tell(policy, element, |policy| {
            let channel = channel_of(policy.contract(), channel)?;
            if let Some(found) = channel.element(index) {
                return Ok(LadsElement::new(&found));
            }
            // Elements without descriptions have their limits in common.
            let limits = channel.limits().nth(index).ok_or(Status::NoElement)?;
            Ok(LadsElement::alike(limits))
        })
    })
}

/// Writes an instruction that the policy knows, by its number.
///
/// # Safety
/// The conditions of `lads_policy_contract` hold.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_policy_instruction(
    policy: *const LadsPolicy,
    number: u32,
    instruction: *mut LadsInstruction,
) -> Status {
    // SAFETY: the caller guarantees both.
    status(unsafe {
        tell(policy, instruction, |policy| {
            let contract = policy.contract();
            let found = contract.instruction(number as usize);
            let found = found.ok_or(Status::UnknownInstruction)?;
            Ok(LadsInstruction::new(&found, contract.word_dim()))
        })
    })
}

/// Finds the number of the instruction with this id, or of the first with this text, up to the case of ASCII letters and white space.
///
/// # Safety
/// The conditions of `lads_policy_contract` hold; `name` points to `name_len` bytes, no zero needed; `number` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_policy_find_instruction(
    policy: *const LadsPolicy,
    name: *const c_char,
    name_len: usize,
    number: *mut u32,
) -> Status {
    // SAFETY: the caller guarantees all three.
    status(unsafe {
        find(policy, name, name_len, number, |contract, name| {
            let found = contract.instructions_called(name).next();
            found.ok_or(Status::UnknownInstruction)
        })
    })
}
