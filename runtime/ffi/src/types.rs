//! What C sees: structs of plain numbers and pointers. Those that may grow begin with `struct_bytes`.

mod describe;
mod options;
mod reports;

pub use describe::*;
pub use options::*;
pub use reports::*;

/// No channel, element or other number: stands where there is none.
pub const LADS_NONE: u32 = u32::MAX;
