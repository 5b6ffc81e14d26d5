//! Dense kernels for batch-1 policies.
#![no_std]
