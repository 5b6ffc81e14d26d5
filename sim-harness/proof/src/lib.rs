//! Judges policies by their numbers: success rates and their intervals, statistics of pairs, and the certificate with its verdict.
//!
//! It runs no policy and no simulator, and knows neither: episodes, answers and states come in as numbers. What can fail: a reference that
//! cannot be read or is of something else ([`mod@reference`]).
//!
#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

pub mod answers;
pub mod certificate;
pub mod contract;
pub mod episode;
pub mod faults;
pub mod frames;
pub mod metrics;
pub mod numbering;
pub mod page;
pub mod pairs;
pub mod physics;
pub mod purpose;
pub mod reference;
pub mod results;
pub mod rounding;
pub mod scores;
pub mod statistics;
pub mod timing;
