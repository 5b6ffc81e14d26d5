//! Compares what cameras show a policy with what they showed the reference: frames are the same if every byte is.
//!
//! A reference keeps states, from which frames are drawn again, and a digest of each step's frames. Another renderer (a library of OpenGL, its
//! driver, a processor) may draw other bytes; then nothing is known of the policy from that step on, which is no fault of it. Nothing here
//! can fail.

use std::collections::BTreeMap;

use serde::Serialize;
use sha2::{Digest as _, Sha256};

use crate::answers::Answer;

/// Number of bytes of a [`Digest`].
pub const DIGEST_LEN: usize = 16;

/// First bytes of the SHA-256 of all that cameras show at a control step.
pub type Digest = [u8; DIGEST_LEN];

/// Computes the digest of a control step's frames, those of all cameras in the contract's order.
pub fn digest<'f>(frames: impl IntoIterator<Item = &'f [u8]>) -> Digest {
    let mut hash = Sha256::new();
    frames.into_iter().for_each(|frame| hash.update(frame));
    let hash: [u8; 32] = hash.finalize().into();
    std::array::from_fn(|i| hash.get(i).copied().unwrap_or_default())
}

/// Comparison of the frames that are drawn from the reference's states.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Frames {
    /// Number of control steps whose frames were compared.
    pub steps: usize,
    /// Number of control steps whose frames differ.
    pub differing: usize,
    /// Number of control steps whose questions were left out, because a frame of that step or an earlier one of the episode differs.
    pub left_out: usize,
    /// Number of episodes with a frame that differs.
    pub differing_episodes: usize,
    /// First control step whose frames differ.
    pub first_difference: Option<Answer>,
    /// Versions of what drew the reference's frames, by name.
    pub reference_renderer: BTreeMap<String, String>,
}

impl Frames {
    /// Compares the frames of an episode's steps, in order, and returns how many are the same before the first that differ.
    pub fn compare(
        &mut self,
        (instruction, episode): (&str, usize),
        shown: &[Digest],
        recorded: &[Digest],
    ) -> usize {
        let pairs = || shown.iter().zip(recorded);
        let same = pairs().take_while(|(ours, theirs)| ours == theirs).count();
        let differing = pairs().filter(|(ours, theirs)| ours != theirs).count();
        self.steps += recorded.len();
        self.differing += differing;
        self.left_out += recorded.len() - same;
        if same < recorded.len() {
            self.differing_episodes += 1;
            self.first_difference.get_or_insert_with(|| Answer {
                instruction: instruction.to_owned(),
                episode,
                step: same,
                what: format!("{differing} of the episode's {} frames", recorded.len()),
            });
        }
        same
    }

    /// Why what was compared is not enough, if it is not.
    pub fn undecided(&self) -> Option<String> {
        let Some(first) = &self.first_difference else {
            return (self.steps == 0)
                .then(|| "no frame was compared: the reference's traces hold none".to_owned());
        };
        let by = self.reference_renderer.iter();
        let by = by.map(|(name, version)| format!("{name} {version}"));
        Some(format!(
            "the renderer here draws {} of {} frames otherwise than the reference's ({}), first in {first}; {} questions were left out: \
             verify where the reference was made, or make one here",
            self.differing,
            self.steps,
            by.collect::<Vec<_>>().join(", "),
            self.left_out
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn digests(bytes: &[u8]) -> Vec<Digest> {
        bytes.iter().map(|&byte| digest([&[byte][..]])).collect()
    }

    #[test]
    fn a_digest_is_of_all_bytes_whatever_frames_they_stand_in() {
        let [a, b] = [b"ab".as_slice(), b"c"];
        assert_eq!(digest([a, b]), digest([b"abc".as_slice()]));
        // sha256 of "abc".
        assert_eq!(digest([a, b])[..4], [0xba, 0x78, 0x16, 0xbf]);
        assert_ne!(digest([a]), digest([b]));
    }

    #[test]
    fn an_episode_counts_up_to_its_first_other_frame() {
        let mut frames = Frames::default();
        assert_eq!(
            frames.compare(("a", 0), &digests(&[1, 2]), &digests(&[1, 2])),
            2
        );
        assert_eq!(frames.undecided(), None);
        let other = frames.compare(("b", 1), &digests(&[1, 9, 3, 8]), &digests(&[1, 2, 3, 4]));
        assert_eq!(other, 1);
        assert_eq!((frames.steps, frames.differing, frames.left_out), (6, 2, 3));
        let said = frames.undecided().unwrap();
        assert!(
            said.contains("2 of 6 frames") && said.contains("3 questions"),
            "{said}"
        );
        assert_eq!(frames.first_difference.unwrap().step, 1);
        assert!(Frames::default().undecided().is_some());
    }
}
