//! The recorded episode that a policy replays to test itself on its target.

use lads_image::codec::{Field, Reader};
use lads_image::records::{self, GoldenRecord};

use crate::contract::{ChannelId, Contract, DType};
use crate::inputs::{Data, Given, MAX_OBSERVATIONS};
use crate::schedule::Sizes;

/// A checked view on the recorded episode: the observation, the index in force and the action of
/// each control step.
#[derive(Debug, Clone, Copy)]
pub struct Golden<'a> {
    record: GoldenRecord,
    /// Words of the section after its record.
    words: &'a [u32],
    /// Locations of the values of each observation channel. They are offsets, not slices, because a
    /// self-test runs on small stacks.
    observations: [Option<Recorded>; MAX_OBSERVATIONS],
    selected: &'a [u32],
    noise: &'a [f32],
    actions: &'a [f32],
    action_len: usize,
}

/// Values of one channel over all steps: `steps * len` values from word `first` of the section.
#[derive(Debug, Clone, Copy)]
struct Recorded {
    channel: ChannelId,
    dtype: DType,
    len: u32,
    first: u32,
}

impl Recorded {
    /// Returns the channel's values at step `i`.
    fn at<'a>(&self, words: &'a [u32], i: usize) -> Option<Data<'a>> {
        let words = words.get(self.first as usize..)?;
        let len = self.len as usize;
        let start = i.checked_mul(len)?;
        let range = start..start.checked_add(len)?;
        Some(match self.dtype {
            DType::F32 => Data::F32(bytemuck::try_cast_slice(words.get(range)?).ok()?),
            DType::I32 => Data::I32(bytemuck::try_cast_slice(words.get(range)?).ok()?),
            DType::U8 => Data::U8(
                bytemuck::try_cast_slice::<u32, u8>(words)
                    .ok()?
                    .get(range)?,
            ),
        })
    }
}

/// One recorded control step.
#[derive(Debug, Clone, Copy)]
pub struct GoldenStep<'a> {
    pub(crate) given: Given<'a>,
    /// The index in force, if the policy selects one.
    pub selected: Option<u32>,
    /// All draws of noise in the order in which they are used; empty for a policy without noise.
    pub noise: &'a [f32],
    /// The action, after clipping to the contract's limits.
    pub action: &'a [f32],
}

impl<'a> GoldenStep<'a> {
    /// Returns the observation of this step, one row for each observation channel in the contract's
    /// order.
    pub fn observations(&self) -> &[(ChannelId, Data<'a>)] {
        self.given.all()
    }

    /// Returns the values of the only observation channel; empty for a policy that has others, or
    /// one of another type.
    pub fn observation(&self) -> &'a [f32] {
        match self.given.all() {
            [(_, Data::F32(values))] => values,
            _ => &[],
        }
    }
}

impl<'a> Golden<'a> {
    /// Checks the golden section; `None` when it contradicts the contract.
    #[inline(never)]
    pub(crate) fn new_checked(contract: &Contract<'a>, sizes: &Sizes) -> Option<Self> {
        let (record, mut rest) = contract
            .tables
            .golden()
            .split_at_checked(GoldenRecord::WORDS)?;
        let record = GoldenRecord::take(&mut Reader::new(record))?;
        let steps = record.steps as usize;
        let words = rest;
        let mut take = |words: usize| {
            let (part, behind) = rest.split_at_checked(words)?;
            rest = behind;
            Some(part)
        };
        let mut observations = [None; MAX_OBSERVATIONS];
        let mut places = observations.iter_mut();
        let mut first = 0_usize;
        for channel in contract.observations() {
            let len = channel.len();
            let all = steps.checked_mul(len)?;
            let dtype = channel.dtype();
            let taken = match dtype {
                DType::F32 | DType::I32 => all,
                DType::U8 => all.div_ceil(4),
            };
            take(taken)?;
            *places.next()? = Some(Recorded {
                channel: channel.id(),
                dtype,
                len: len as u32,
                first: first as u32,
            });
            first = first.checked_add(taken)?;
        }
        let selected = take(if record.selects { steps } else { 0 })?;
        let noise = take(steps.checked_mul(record.noise_len as usize)?)?;
        let action_len = contract.action_len();
        let actions = take(steps.checked_mul(action_len)?)?;
        let known = if contract.instruction_channel().is_some() {
            (record.instruction as usize) < contract.instruction_count()
        } else {
            record.instruction == records::NONE
        };
        let tolerance = record.tolerance.is_finite() && record.tolerance >= 0.0;
        let selects = record.selects == sizes.scores.is_some();
        let noisy = record.noise_len as usize == sizes.noise_len;
        let complete = steps > 0 && rest.is_empty() && selects && noisy;
        (known && tolerance && complete).then_some(Self {
            record,
            words,
            observations,
            selected,
            noise: bytemuck::try_cast_slice(noise).ok()?,
            actions: bytemuck::try_cast_slice(actions).ok()?,
            action_len,
        })
    }

    /// Returns the number of the instruction that was followed; `None` for a policy that takes
    /// none.
    pub fn instruction(&self) -> Option<u32> {
        (self.record.instruction != records::NONE).then_some(self.record.instruction)
    }

    /// Returns the number of control steps.
    pub fn len(&self) -> usize {
        self.record.steps as usize
    }

    /// Always returns false: an episode has at least one step.
    pub fn is_empty(&self) -> bool {
        self.record.steps == 0
    }

    /// Returns the largest absolute difference of an action that the self-test accepts.
    pub fn tolerance(&self) -> f32 {
        self.record.tolerance
    }

    /// Returns recorded step `i`.
    pub fn step(&self, i: usize) -> Option<GoldenStep<'a>> {
        let mut given = Given::default();
        self.observe(i, &mut given)?;
        Some(GoldenStep {
            given,
            selected: self.selected(i),
            noise: self.noise(i)?,
            action: self.action(i)?,
        })
    }

    /// Adds the observation of step `i`.
    pub(crate) fn observe(&self, i: usize, given: &mut Given<'a>) -> Option<()> {
        for recorded in self.observations.iter().flatten() {
            given.push(recorded.channel, recorded.at(self.words, i)?);
        }
        Some(())
    }

    /// Returns the index in force in step `i`.
    pub(crate) fn selected(&self, i: usize) -> Option<u32> {
        self.selected.get(i).copied()
    }

    /// Returns all draws of step `i`.
    pub(crate) fn noise(&self, i: usize) -> Option<&'a [f32]> {
        row(self.noise, i, self.record.noise_len as usize)
    }

    /// Returns the action of step `i`.
    pub(crate) fn action(&self, i: usize) -> Option<&'a [f32]> {
        row(self.actions, i, self.action_len)
    }

    /// Returns all recorded steps in order.
    pub fn steps(&self) -> impl Iterator<Item = GoldenStep<'a>> + use<'a> {
        let golden = *self;
        (0..self.len()).map_while(move |i| golden.step(i))
    }
}

/// Returns row `i`, of `len` values.
fn row(values: &[f32], i: usize, len: usize) -> Option<&[f32]> {
    let start = i.checked_mul(len)?;
    values.get(start..start.checked_add(len)?)
}
