//! From C's pointer and length to a slice: what can be checked is checked here, what cannot is the caller's promise.

use core::ops::Range;
use core::{ptr, slice};

use crate::status::Status;

/// Checks that a pointer may be that of `len` elements: not null, aligned, no longer than memory can be.
pub fn check<T>(pointer: *const T, len: usize) -> Result<(), Status> {
    if pointer.is_null() {
        return Err(Status::Null);
    }
    if !pointer.is_aligned() {
        return Err(Status::Misaligned);
    }
    let bytes = len
        .checked_mul(size_of::<T>())
        .filter(|&bytes| isize::try_from(bytes).is_ok());
    let end = bytes.and_then(|bytes| pointer.addr().checked_add(bytes));
    end.map(|_| ()).ok_or(Status::TooLong)
}

/// `len` elements to read; a length of zero may come with a null pointer.
///
/// # Safety
/// If the pointer is not null, `len` initialised elements are readable there, and nobody writes them during `'a`.
pub unsafe fn read<'a, T>(pointer: *const T, len: usize) -> Result<&'a [T], Status> {
    if len == 0 {
        return Ok(&[]);
    }
    check(pointer, len)?;
    // SAFETY: checked above to be non-null, aligned and of a possible length; the caller guarantees the memory.
    Ok(unsafe { slice::from_raw_parts(pointer, len) })
}

/// `len` elements to read, or `None` for a null pointer.
///
/// # Safety
/// As [`read`].
pub unsafe fn read_optional<'a, T>(
    pointer: *const T,
    len: usize,
) -> Result<Option<&'a [T]>, Status> {
    if pointer.is_null() {
        return Ok(None);
    }
    // SAFETY: the caller guarantees it.
    unsafe { read(pointer, len) }.map(Some)
}

/// The value behind a pointer.
///
/// # Safety
/// If the pointer is not null, there is an initialised `T` that nobody writes during `'a`.
pub unsafe fn get<'a, T>(pointer: *const T) -> Result<&'a T, Status> {
    check(pointer, 1)?;
    // SAFETY: checked above to be non-null and aligned; the caller guarantees the memory.
    Ok(unsafe { &*pointer })
}

/// `len` elements of memory that need not be initialised; they become zero.
///
/// # Safety
/// If the pointer is not null, `len` writable elements are there, and nobody else uses them during `'a`.
pub unsafe fn zeroed<'a>(pointer: *mut f32, len: usize) -> Result<&'a mut [f32], Status> {
    if len == 0 {
        return Ok(&mut []);
    }
    check(pointer, len)?;
    // SAFETY: checked above to be non-null, aligned and of a possible length; the caller guarantees that the memory is writable
    // and nobody else's. All bits zero is the number zero.
    unsafe {
        pointer.write_bytes(0, len);
        Ok(slice::from_raw_parts_mut(pointer, len))
    }
}

/// Writes a result of the call.
///
/// # Safety
/// If the pointer is not null, a `T` may be written there.
pub unsafe fn give<T>(to: *mut T, value: T) -> Result<(), Status> {
    check(to, 1)?;
    // SAFETY: not null and aligned; the caller guarantees that it may be written.
    unsafe { ptr::write(to, value) };
    Ok(())
}

/// The addresses of `len` elements.
pub fn addresses<T>(pointer: *const T, len: usize) -> Range<usize> {
    let start = pointer.addr();
    start..start.saturating_add(len.saturating_mul(size_of::<T>()))
}

/// True when the ranges share no address.
pub fn apart(a: &Range<usize>, b: &Range<usize>) -> bool {
    a.end <= b.start || b.end <= a.start
}
