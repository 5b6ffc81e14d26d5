//! A policy: one program image, checked once.
//!
//! [`Policy::new_checked`] copies nothing and allocates nothing; the policy borrows the image. It
//! proves every property that running relies on: the tables decode, every program is well formed,
//! every port fits what it is bound to, and every step of the longest context can be taken (the
//! module `schedule` says what that means). An image cannot ask for memory that its own programs do
//! not use, or for more work than a limit that the caller may set. It does not read the weights:
//! [`Policy::checksum_matches`] does.

use core::error::Error;
use core::fmt;

use lads_image::Tables;
use lads_image::tables::TablesError;

use crate::contract::{Contract, ContractError};
use crate::golden::Golden;
use crate::schedule::{self, ScheduleError, Sizes};

/// A checked view on a program image.
#[derive(Debug, Clone, Copy)]
pub struct Policy<'a> {
    pub(crate) sizes: Sizes,
    contract: Contract<'a>,
    has_golden: bool,
}

impl<'a> Policy<'a> {
    /// Largest number of multiply-adds that a control step may take unless the caller sets another
    /// limit: some seconds on a fast core.
    pub const WORK_LIMIT: u64 = 1 << 35;

    /// Largest workspace, in bytes, that a host gives any policy. Real policies take a few
    /// megabytes, and an operating system that promises more memory than it has would let an image
    /// take all of it; where the caller brings the memory, nothing asks for this limit.
    pub const MEMORY_LIMIT: usize = 1 << 30;

    /// Opens an image that starts on a 4-byte boundary (64 is better); bytes after the image's own length are ignored.
    pub fn new_checked(image: &'a [u8]) -> Result<Self, PolicyError> {
        Self::new_within(image, Self::WORK_LIMIT)
    }

    /// Opens an image whose worst step takes at most `work_limit` multiply-adds.
    pub fn new_within(image: &'a [u8], work_limit: u64) -> Result<Self, PolicyError> {
        let tables = Tables::new(image).map_err(PolicyError::Tables)?;
        let contract = Contract::new_checked(tables).map_err(PolicyError::Contract)?;
        let sizes = schedule::check(&tables, &contract).map_err(PolicyError::Schedule)?;
        if sizes.work > work_limit {
            return Err(PolicyError::Work {
                needed: sizes.work,
                limit: work_limit,
            });
        }
        let has_golden = !tables.golden().is_empty();
        if has_golden && Golden::new_checked(&contract, &sizes).is_none() {
            return Err(PolicyError::Golden);
        }
        Ok(Self {
            sizes,
            contract,
            has_golden,
        })
    }

    /// Returns the policy's contract: its channels and instructions.
    #[inline]
    pub fn contract(&self) -> &Contract<'a> {
        &self.contract
    }

    /// Returns the recorded episode of the self-test, if the image holds one.
    pub fn golden(&self) -> Option<Golden<'a>> {
        // Read again rather than kept: a view takes more memory than the policy, and only a self-test wants it.
        self.has_golden
            .then(|| Golden::new_checked(&self.contract, &self.sizes))
            .flatten()
    }

    #[inline]
    pub(crate) fn tables(&self) -> &Tables<'a> {
        &self.contract.tables
    }

    /// Returns the image, without the bytes after it.
    pub fn image(&self) -> &'a [u8] {
        self.tables().image()
    }

    /// Returns the size of the image in bytes.
    pub fn image_bytes(&self) -> usize {
        self.image().len()
    }

    /// Returns the number of elements of scratch memory that a controller needs: the largest
    /// program's arena.
    pub fn arena_len(&self) -> usize {
        self.sizes.arena_len
    }

    /// Returns the number of elements of memory that survive a control step: rings and KV caches,
    /// twice (those in force and the next ones) the plain states and the action, and the values
    /// that programs of one step hand to each other.
    pub fn state_len(&self) -> usize {
        let bank = self
            .sizes
            .bank_len
            .saturating_add(self.contract.action_len());
        self.sizes
            .rows_len
            .saturating_add(bank.saturating_mul(2))
            .saturating_add(self.sizes.scratch_len)
    }

    /// Returns the number of indices to select from; 0 for a policy that selects nothing.
    pub fn index_count(&self) -> u32 {
        self.sizes.scores.map_or(0, |scores| scores.width)
    }

    /// Returns the largest number of elements of noise that a control step takes; 0 for a policy
    /// without noise.
    pub fn noise_len(&self) -> usize {
        self.sizes.noise_len
    }

    /// Returns whether the policy offers [`Controller::follow`](crate::Controller::follow).
    pub fn follows(&self) -> bool {
        self.sizes.follows
    }

    /// Returns whether the policy offers [`Controller::encode`](crate::Controller::encode).
    pub fn encodes(&self) -> bool {
        self.sizes.encodes
    }

    /// Reads the whole image and compares its checksum: true if no bit has changed since it was
    /// compiled.
    // Goes over all bytes, and the static library builds this crate for size: compiled where it is called.
    #[inline]
    pub fn checksum_matches(&self) -> bool {
        self.tables().checksum_matches()
    }
}

/// Reason why an image was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum PolicyError {
    /// The bytes are damaged or not an image of this version.
    Tables(TablesError),
    /// The contract is invalid.
    Contract(ContractError),
    /// States, entries and calls do not form a valid policy.
    Schedule(ScheduleError),
    /// The recorded episode contradicts the contract.
    Golden,
    /// A control step takes more work than the caller allows.
    Work {
        /// Multiply-adds of the worst step.
        needed: u64,
        /// Multiply-adds that the caller allows.
        limit: u64,
    },
}

impl fmt::Display for PolicyError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Tables(error) => error.fmt(f),
            Self::Contract(error) => write!(f, "contract: {error}"),
            Self::Schedule(error) => write!(f, "schedule: {error}"),
            Self::Golden => f.write_str("the recorded episode contradicts the contract"),
            Self::Work { needed, limit } => write!(
                f,
                "the worst control step takes {needed} multiply-adds, {limit} are allowed"
            ),
        }
    }
}

impl Error for PolicyError {}
