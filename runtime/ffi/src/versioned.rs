//! Structs that can grow without breaking programs: each begins with its own size as the caller knows it.
//!
//! A newer library with an older caller reads and writes only the caller's fields; an older library
//! with a newer caller only the fields that it knows itself, and refuses options that it does not
//! know unless they are zero. What can fail: a size that is smaller than the struct ever was, or no
//! size at all ([`Status::StructBytes`]).

use core::ptr;
use core::slice;

use crate::memory::{Area, check};
use crate::status::Status;

/// Upper bound of the size of all structs of this interface: a larger size is taken for
/// uninitialised memory.
const MOST: usize = 4096;

/// Number of bytes of the size at the head.
const HEAD: usize = size_of::<u32>();

/// A struct of C whose first field is `struct_bytes`.
///
/// # Safety
/// The type is `repr(C)`, its first field is a `u32`, and any bits make a value.
pub unsafe trait Versioned: Copy + Default {
    /// Size of the struct when it first appeared. Fields that are added later follow, and `Default`
    /// is their value when absent.
    const FIRST_BYTES: usize;
}

/// Returns the size that the caller states, once it is plausible.
///
/// # Safety
/// If the pointer is not null, a `u32` is readable there.
unsafe fn stated<T: Versioned>(pointer: *const T) -> Result<usize, Status> {
    check(pointer, 1)?;
    // SAFETY: not null and aligned for `T`, which begins with a `u32`; the caller guarantees that it is there.
    let bytes = unsafe { pointer.cast::<u32>().read() } as usize;
    if (T::FIRST_BYTES..=MOST).contains(&bytes) {
        Ok(bytes)
    } else {
        Err(Status::StructBytes)
    }
}

/// Returns the area of options: all of the caller's bytes.
///
/// # Safety
/// The conditions of [`read`] hold; a null pointer has an empty area.
pub unsafe fn read_area<T: Versioned>(pointer: *const T) -> Result<Area, Status> {
    if pointer.is_null() {
        return Ok(Area::read(pointer, 0));
    }
    // SAFETY: the caller guarantees it.
    let bytes = unsafe { stated(pointer) }?;
    Ok(Area::read(pointer.cast::<u8>(), bytes))
}

/// Returns the area of a report: the bytes that both sides know.
///
/// # Safety
/// The conditions of [`write`] hold; a null pointer has an empty area.
pub unsafe fn write_area<T: Versioned>(pointer: *mut T) -> Result<Area, Status> {
    if pointer.is_null() {
        return Ok(Area::written(pointer, 0));
    }
    // SAFETY: the caller guarantees it.
    let bytes = unsafe { stated(pointer) }?;
    Ok(Area::written(
        pointer.cast::<u8>(),
        bytes.min(size_of::<T>()),
    ))
}

/// Reads options, as far as both sides know them.
///
/// # Safety
/// If the pointer is not null, as many initialised bytes as `struct_bytes` says are readable there.
pub unsafe fn read<T: Versioned>(pointer: *const T) -> Result<T, Status> {
    // SAFETY: the caller guarantees it.
    let bytes = unsafe { stated(pointer) }?;
    let known = bytes.min(size_of::<T>());
    let mut value = T::default();
    let from = pointer.cast::<u8>();
    // SAFETY: both hold `known` bytes, and any bits make a `T`.
    unsafe { ptr::copy_nonoverlapping(from, (&raw mut value).cast::<u8>(), known) };
    // SAFETY: the caller guarantees `bytes` bytes, and `known` is no more.
    let beyond =
        unsafe { slice::from_raw_parts(from.wrapping_add(known), bytes.saturating_sub(known)) };
    if beyond.iter().any(|&byte| byte != 0) {
        return Err(Status::UnknownOption);
    }
    Ok(value)
}

/// Writes a report, as far as both sides know it; the size that the caller has set stays.
///
/// # Safety
/// If the pointer is not null, as many writable bytes as its `struct_bytes` says are there.
pub unsafe fn write<T: Versioned>(pointer: *mut T, value: &T) -> Result<(), Status> {
    // SAFETY: the caller guarantees it.
    let known = unsafe { stated(pointer) }?.min(size_of::<T>());
    let from = ptr::from_ref(value).cast::<u8>().wrapping_add(HEAD);
    let to = pointer.cast::<u8>().wrapping_add(HEAD);
    // SAFETY: both hold `known` bytes, the size at their heads included.
    unsafe { ptr::copy_nonoverlapping(from, to, known.saturating_sub(HEAD)) };
    Ok(())
}

/// Implements [`Versioned`] for a struct at its first version.
macro_rules! versioned {
    ($($name:ident),* $(,)?) => {
        $(
            // SAFETY: a `repr(C)` struct of numbers and pointers whose first field is a `u32`.
            unsafe impl $crate::versioned::Versioned for $name {
                const FIRST_BYTES: usize = size_of::<$name>();
            }
        )*
    };
}
pub(crate) use versioned;
