//! Finds a known instruction by what a person wrote.
//!
//! The rule is [`Contract::instructions_called`], the same everywhere; this module adds the error
//! for an unknown instruction ([`UnknownInstruction`]).

use lads_core::Contract;

/// Number of known instructions that are suggested for an unknown one.
const SUGGESTIONS: usize = 3;

/// Letters of an unknown instruction that are compared with the known ones: the time is their
/// number times that of the known ones' letters, and what is longer is no slip of the pen.
const COMPARED: usize = 200;

/// Letters of an unknown instruction that a message repeats.
const SHOWN: usize = 60;

/// Returns the number of the first known instruction with this id, or with this text up to case and
/// white space.
pub fn find(contract: &Contract, wanted: &str) -> Result<u32, UnknownInstruction> {
    let found = contract.instructions_called(wanted.as_bytes()).next();
    found.ok_or_else(|| {
        let known = contract.instructions().map(|known| (known.id, known.text));
        let nearest = nearest(known, wanted).into_iter().take(SUGGESTIONS);
        UnknownInstruction {
            wanted: wanted.to_owned(),
            nearest: nearest
                .map(|(id, text)| (id.to_owned(), text.to_owned()))
                .collect(),
        }
    })
}

/// Returns known instructions (id and text), those first whose id or text is most similar to what a
/// person wrote.
pub fn nearest<'a>(
    known: impl Iterator<Item = (&'a str, &'a str)>,
    wanted: &str,
) -> Vec<(&'a str, &'a str)> {
    let wanted = plain(&first(wanted, COMPARED));
    let like = |known: &str| strsim::normalized_damerau_levenshtein(&wanted, &plain(known));
    let mut scored: Vec<_> = known
        .map(|(id, text)| (like(text).max(like(id)), (id, text)))
        .collect();
    scored.sort_by(|(a, _), (b, _)| b.total_cmp(a));
    scored.into_iter().map(|(_, known)| known).collect()
}

/// Returns the first letters of a text.
fn first(text: &str, letters: usize) -> String {
    text.chars().take(letters).collect()
}

/// Returns a caller's text as a message repeats it: its beginning, where it is long.
pub fn shown(text: &str) -> String {
    let start = first(text, SHOWN);
    let rest = if start.len() < text.len() { "…" } else { "" };
    start + rest
}

/// Normalises a text to lower case and single spaces.
fn plain(text: &str) -> String {
    text.to_lowercase()
        .split_whitespace()
        .collect::<Vec<_>>()
        .join(" ")
}

/// Error: a policy does not know the instruction that it was given.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "instruction '{}': the policy does not know it; {}",
    shown(wanted),
    remedy(nearest)
)]
pub struct UnknownInstruction {
    /// The unknown instruction.
    pub wanted: String,
    /// Ids and texts of the known instructions that are most similar, the best first; empty if the
    /// policy takes no instruction.
    pub nearest: Vec<(String, String)>,
}

fn remedy(nearest: &[(String, String)]) -> String {
    if nearest.is_empty() {
        return "it knows no instructions, so give none".into();
    }
    let shown: Vec<_> = nearest
        .iter()
        .map(|(id, text)| format!("'{text}' ({id})"))
        .collect();
    format!("the nearest that it knows: {}", shown.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_alike_comes_first() {
        let known = [("k", "move the kettle"), ("d", "open the drawer")];
        let best = |wanted| nearest(known.into_iter(), wanted)[0].0;
        assert_eq!(best("open the drower"), "d");
        assert_eq!(best("K"), "k");
    }

    #[test]
    fn what_is_too_long_is_compared_and_shown_by_its_beginning() {
        let known = [("k", "move the kettle"), ("d", "open the drawer")];
        let wanted = "é".repeat(1_000_000);
        let ordered = nearest(known.into_iter(), &wanted);
        assert_eq!(ordered.len(), 2);
        let start = format!("open the drower{}", " ".repeat(1_000_000));
        assert_eq!(nearest(known.into_iter(), &start)[0].0, "d");
        let said = UnknownInstruction {
            wanted,
            nearest: vec![],
        };
        assert!(said.to_string().contains("éé…'") && said.to_string().chars().count() < 200);
    }

    #[test]
    fn a_refusal_says_what_is_known() {
        let nearest = vec![("d".to_owned(), "open the drawer".to_owned())];
        let wanted = "sing".to_owned();
        let said = UnknownInstruction { wanted, nearest }.to_string();
        assert_eq!(
            said,
            "instruction 'sing': the policy does not know it; the nearest that it knows: 'open the drawer' (d)"
        );
    }
}
