//! Program image, executor, policy and controller.
#![no_std]
#![forbid(unsafe_code)]
