//! Demonstrations for training: scripted experts, collections of their episodes, and the dataset file.

pub mod collect;
pub mod dataset;
pub mod expert;
pub mod instructions;
