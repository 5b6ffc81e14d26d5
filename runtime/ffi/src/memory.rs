//! Converts C's pointer and length to a slice, and refuses memory areas that overlap: checks
//! everything that can be checked; the rest is the caller's promise.

use core::slice;

use crate::status::Status;

/// Checks that a pointer may be that of `len` elements: not null, aligned, no longer than memory
/// can be.
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

/// Returns `len` elements to read; a length of zero may come with a null pointer.
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

/// Returns `len` elements to read, or `None` for a null pointer.
///
/// # Safety
/// The conditions of [`read`] hold.
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

/// Zeroes `len` elements of memory, which need not be initialised, and returns them.
///
/// # Safety
/// If the pointer is not null, `len` writable elements are there, and nobody else uses them during `'a`.
pub unsafe fn zeroed<'a>(pointer: *mut f32, len: usize) -> Result<&'a mut [f32], Status> {
    if len == 0 {
        return Ok(&mut []);
    }
    check(pointer, len)?;
    // SAFETY: checked above to be non-null, aligned and of a possible length; the caller guarantees that the memory is writable
    // and only theirs. All bits zero is the number zero.
    unsafe {
        pointer.write_bytes(0, len);
        Ok(slice::from_raw_parts_mut(pointer, len))
    }
}

/// Address range of one object that a call reads or writes. The range of a null pointer is empty.
#[derive(Debug, Clone, Copy)]
pub struct Area {
    start: usize,
    end: usize,
    written: bool,
}

impl Area {
    /// Makes the area of elements that are read.
    pub fn read<T>(pointer: *const T, len: usize) -> Self {
        let start = pointer.addr();
        let bytes = if pointer.is_null() {
            0
        } else {
            len.saturating_mul(size_of::<T>())
        };
        Self {
            start,
            end: start.saturating_add(bytes),
            written: false,
        }
    }

    /// Makes the area of elements that are written, or read and written.
    pub fn written<T>(pointer: *mut T, len: usize) -> Self {
        Self {
            written: true,
            ..Self::read(pointer, len)
        }
    }

    /// Returns whether both hold an address, and one of them is written.
    pub fn clashes(&self, other: &Self) -> bool {
        let apart = self.end <= other.start || other.end <= self.start;
        let empty = self.start == self.end || other.start == other.end;
        !apart && !empty && (self.written || other.written)
    }
}

/// Refuses an area that clashes with one of the others.
pub fn apart_from(area: &Area, others: &[Area]) -> Result<(), Status> {
    if others.iter().any(|other| area.clashes(other)) {
        return Err(Status::Overlap);
    }
    Ok(())
}

/// Refuses a call two of whose areas clash: one rule for every pointer of every function.
pub fn apart(areas: &[Area]) -> Result<(), Status> {
    let mut rest = areas;
    while let [first, others @ ..] = rest {
        apart_from(first, others)?;
        rest = others;
    }
    Ok(())
}
