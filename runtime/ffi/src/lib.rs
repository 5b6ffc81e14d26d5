//! The C boundary.
#![no_std]
