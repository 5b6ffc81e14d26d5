//! What cameras show in the states of a reference, drawn once for all who are asked, and whether it is what they showed the reference.
//!
//! Frames are kept in a temporary file: some references have gigabytes of them. What can fail: a camera that cannot be drawn, no room for
//! temporary files; it can be told to stop.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, Write as _};
use std::os::unix::fs::FileExt as _;
use std::sync::atomic::{AtomicBool, Ordering};

use lads_compiler::Contract;
use lads_core::{ChannelId, Data, Policy};
use lads_proof::frames::{Frames, digest};
use lads_proof::reference::Reference;

use crate::environment::Environment;
use crate::evaluate::{Assignment, EvaluationError};
use crate::sight::Sight;

/// Frames of a reference's traced episodes.
#[derive(Debug)]
pub struct Shown {
    file: File,
    /// Cameras, with the bytes of a frame of each.
    cameras: Vec<(ChannelId, usize)>,
    episodes: HashMap<[usize; 2], Kept>,
    /// Comparison with what the reference was shown.
    pub compared: Frames,
}

/// Frames of one episode.
#[derive(Debug, Clone, Copy)]
struct Kept {
    /// Place of its first byte in the file.
    from: u64,
    /// Steps whose frames are the reference's, before the first that are not.
    same: usize,
}

impl Shown {
    /// Draws the first `episodes` traced episodes of each instruction; `None` for a policy without cameras.
    pub fn draw(
        (contract, policy): (&Contract, &Policy<'_>),
        environment: &dyn Environment,
        (reference, assignments, episodes): (&Reference, &[Assignment], u32),
        stop: &AtomicBool,
    ) -> Result<Option<Self>, EvaluationError> {
        let sight = Sight::of(contract, policy, environment);
        let mut sight = sight.map_err(EvaluationError::Sight)?;
        let cameras: Vec<_> = sight.shown().map(|(id, shown)| (id, shown.len())).collect();
        if cameras.is_empty() {
            return Ok(None);
        }
        let mut file = tempfile::tempfile().map_err(EvaluationError::Frames)?;
        let (mut kept, mut from) = (HashMap::new(), 0);
        let mut compared = Frames {
            reference_renderer: reference.renderer.clone(),
            ..Frames::default()
        };
        for index in assignments.iter().map(|it| it.instruction as usize) {
            let Some(instruction) = reference.instructions.get(index) else {
                continue;
            };
            let asked = instruction.episodes.iter().take(episodes as usize);
            for (number, episode) in asked.enumerate() {
                let Some(trace) = &episode.trace else {
                    continue;
                };
                let begin = from;
                let mut digests = Vec::with_capacity(trace.frames.len());
                let states = trace.states.chunks_exact(environment.state().len());
                for state in states.take(trace.frames.len()) {
                    if stop.load(Ordering::Relaxed) {
                        return Err(EvaluationError::Interrupted);
                    }
                    sight.look(state).map_err(EvaluationError::Sight)?;
                    digests.push(digest(sight.shown().map(|(_, shown)| shown)));
                    for (_, shown) in sight.shown() {
                        file.write_all(shown).map_err(EvaluationError::Frames)?;
                        from += shown.len() as u64;
                    }
                }
                let place = (instruction.id.as_str(), number);
                let same = compared.compare(place, &digests, &trace.frames);
                kept.insert([index, number], Kept { from: begin, same });
            }
        }
        Ok(Some(Self {
            file,
            cameras,
            episodes: kept,
            compared,
        }))
    }

    /// How many steps of an episode may be asked about: those before its first frame that is not the reference's.
    pub fn same(&self, instruction: usize, episode: usize) -> usize {
        let kept = self.episodes.get(&[instruction, episode]);
        kept.map_or(0, |kept| kept.same)
    }

    /// Reads the frames of a control step into `to`.
    pub fn read(
        &self,
        (instruction, episode, step): (usize, usize, usize),
        to: &mut Vec<u8>,
    ) -> io::Result<()> {
        let len: usize = self.cameras.iter().map(|(_, len)| len).sum();
        let kept = self.episodes.get(&[instruction, episode]);
        let kept = kept.ok_or(io::ErrorKind::NotFound)?;
        to.resize(len, 0);
        self.file.read_exact_at(to, kept.from + (step * len) as u64)
    }

    /// The cameras' channels with their parts of a step's frames.
    pub fn channels<'f>(&self, frames: &'f [u8]) -> Vec<(ChannelId, Data<'f>)> {
        let mut left = frames;
        let cameras = self.cameras.iter();
        cameras
            .map(|&(id, len)| {
                let (own, others) = left.split_at(len.min(left.len()));
                left = others;
                (id, Data::U8(own))
            })
            .collect()
    }
}
