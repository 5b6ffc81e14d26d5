//! Types of the C interface: structs of plain numbers and pointers. Structs that may grow begin
//! with `struct_bytes`.

mod describe;
mod options;
mod reports;

pub use describe::*;
pub use options::*;
pub use reports::*;

/// Number that stands for no channel, element or other index.
pub const LADS_NONE: u32 = u32::MAX;
