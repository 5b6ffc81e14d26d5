//! From C's pointer and length to a slice: what can be checked is checked here, what cannot is the caller's promise.

use core::ops::Range;
use core::slice;

use crate::status::Status;

/// Checks that a pointer may be that of `len` elements: not null, aligned, no longer than memory can be.
fn check<T>(pointer: *const T, len: usize) -> Result<(), Status> {
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

/// `len` elements to read and write, their old values kept.
///
/// # Safety
/// If the pointer is not null, `len` initialised elements are there, and nobody else uses them during `'a`.
pub unsafe fn write<'a, T>(pointer: *mut T, len: usize) -> Result<&'a mut [T], Status> {
    if len == 0 {
        return Ok(&mut []);
    }
    check(pointer, len)?;
    // SAFETY: checked above to be non-null, aligned and of a possible length; the caller guarantees the memory.
    Ok(unsafe { slice::from_raw_parts_mut(pointer, len) })
}

/// `len` elements of memory that need not be initialised; they become zero.
///
/// # Safety
/// If the pointer is not null, `len` writable elements are there, and nobody else uses them during `'a`.
pub unsafe fn zeroed<'a>(pointer: *mut f32, len: usize) -> Result<&'a mut [f32], Status> {
    if len != 0 {
        check(pointer, len)?;
        // SAFETY: checked above; the caller guarantees that the memory is writable. All bits zero is the number zero.
        unsafe { pointer.write_bytes(0, len) };
    }
    // SAFETY: initialised just now; the rest is the caller's guarantee.
    unsafe { write(pointer, len) }
}

/// The addresses of `len` elements.
pub fn addresses<T>(pointer: *const T, len: usize) -> Range<usize> {
    let start = pointer.addr();
    start..start.saturating_add(len.saturating_mul(size_of::<T>()))
}

/// True when no two of the ranges share an address.
pub fn disjoint(ranges: &[Range<usize>]) -> bool {
    let apart = |a: &Range<usize>, b: &Range<usize>| a.end <= b.start || b.end <= a.start;
    ranges
        .iter()
        .enumerate()
        .all(|(i, a)| ranges.iter().skip(i + 1).all(|b| apart(a, b)))
}
