//! Layout of a workspace: the controller's own memory, then arena, state and the guard's memory,
//! each on a cache line.

use core::ffi::c_void;

use lads_core::{GuardedController, Policy};
use lads_image::Tables;

/// Alignment of a workspace, in bytes: a cache line, which is also the widest vector.
pub const LADS_WORKSPACE_ALIGN: usize = 64;

/// Largest stack, in bytes, that a call of the library takes: measured on x86-64 with all functions
/// of the archive. Convolutions with integer weights take most; `lads inspect` tells a policy's own.
pub const LADS_STACK_BYTES: usize = 19456;

/// The same of policies without such convolutions.
const WITHOUT_INTEGER_CONVOLUTIONS: usize = 9216;

/// Returns the largest stack, in bytes, that a call of the library takes for a policy.
pub fn stack_bytes(policy: &Policy<'_>) -> usize {
    let tables = Tables::new(policy.image());
    let integers = |op| match op {
        #[cfg(feature = "conv")]
        lads_image::Op::IntegerConv(_) => true,
        _ => false,
    };
    if tables.iter().flat_map(Tables::every_op).any(integers) {
        LADS_STACK_BYTES
    } else {
        WITHOUT_INTEGER_CONVOLUTIONS
    }
}

/// Offsets of the parts of a workspace, in bytes.
#[derive(Debug, Clone, Copy)]
pub struct Layout {
    pub arena: usize,
    pub state: usize,
    pub guard: usize,
    pub total: usize,
}

impl Layout {
    /// Computes the layout for a policy; `None` if it exceeds the address space.
    pub fn of(policy: &Policy, handle: usize) -> Option<Self> {
        let after = |start: usize, elements: usize| {
            start
                .checked_add(elements.checked_mul(size_of::<f32>())?)?
                .checked_next_multiple_of(LADS_WORKSPACE_ALIGN)
        };
        let arena = handle.checked_next_multiple_of(LADS_WORKSPACE_ALIGN)?;
        let state = after(arena, policy.arena_len())?;
        let guard = after(state, policy.state_len())?;
        let total = after(guard, GuardedController::memory_len(policy))?;
        isize::try_from(total).ok()?;
        Some(Self {
            arena,
            state,
            guard,
            total,
        })
    }
}

/// Returns the elements at an offset of a workspace.
pub fn at(workspace: *mut c_void, offset: usize) -> *mut f32 {
    workspace.wrapping_byte_add(offset).cast()
}
