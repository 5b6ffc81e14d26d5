//! Finds known instructions by what a person wrote, by one rule on every target, without tables.

use crate::contract::Contract;

/// Returns the numbers of the instructions (id and text) that a person means: the one with this id,
/// else all with this text.
///
/// White space around an id does not matter. Texts are compared word by word, the case of ASCII letters and the white space between
/// words do not matter; texts may repeat.
pub fn instructions_called<'w, 'k: 'w>(
    known: impl Iterator<Item = (&'k str, &'k str)> + Clone + 'w,
    wanted: &'w [u8],
) -> impl Iterator<Item = u32> + 'w {
    let id = wanted.trim_ascii();
    // Byte by byte: comparing slices would call `bcmp`, which not every C library has.
    let by_id = (0_u32..)
        .zip(known.clone())
        .find(move |(_, (known, _))| known.bytes().eq(id.iter().copied()));
    let only = by_id.map(|(number, _)| number);
    (0_u32..)
        .zip(known)
        .filter(move |&(number, (_, text))| match only {
            Some(only) => number == only,
            None => same_words(text.as_bytes(), wanted),
        })
        .map(|(number, _)| number)
}

/// Returns whether two texts have the same words, up to the case of ASCII letters.
fn same_words(a: &[u8], b: &[u8]) -> bool {
    let (mut a, mut b) = (words(a), words(b));
    loop {
        match (a.next(), b.next()) {
            (None, None) => return true,
            (Some(a), Some(b)) if a.eq_ignore_ascii_case(b) => {}
            _ => return false,
        }
    }
}

fn words(text: &[u8]) -> impl Iterator<Item = &[u8]> {
    text.split(u8::is_ascii_whitespace)
        .filter(|word| !word.is_empty())
}

impl<'a> Contract<'a> {
    /// Returns the numbers of the instructions that a person means by `wanted`, UTF-8: see
    /// [`instructions_called`].
    pub fn instructions_called<'w>(&self, wanted: &'w [u8]) -> impl Iterator<Item = u32> + 'w
    where
        'a: 'w,
    {
        let contract = *self;
        let known = (0..contract.instruction_count())
            .filter_map(move |i| contract.instruction(i))
            .map(|known| (known.id, known.text));
        instructions_called(known, wanted)
    }
}

#[cfg(test)]
mod tests {
    use super::instructions_called;
    use std::vec::Vec;

    const KNOWN: [(&str, &str); 4] = [
        ("d", "Open the drawer"),
        ("open", "open the drawer"),
        ("ö", "Öffne die Schublade"),
        ("open the drawer", "close it"),
    ];

    fn called(known: &[(&'static str, &'static str)], wanted: &str) -> Vec<u32> {
        instructions_called(known.iter().copied(), wanted.as_bytes()).collect()
    }

    #[test]
    fn an_id_comes_before_texts() {
        assert_eq!(called(&KNOWN, " open\n"), [1]);
        assert_eq!(called(&KNOWN, "open the drawer"), [3]);
        assert_eq!(called(&KNOWN, "D"), [] as [u32; 0], "ids have a case");
    }

    #[test]
    fn texts_match_up_to_case_and_white_space() {
        assert_eq!(called(&KNOWN, "  OPEN\tthe  drawer "), [0, 1]);
        assert_eq!(called(&KNOWN, "Öffne DIE schublade"), [2]);
        for other in ["open the", "open the drawer now", "openthe drawer", ""] {
            assert_eq!(called(&KNOWN, other), [] as [u32; 0], "{other}");
        }
    }
}
