//! MuJoCo environments, rollouts, metrics.
#![forbid(unsafe_code)]
