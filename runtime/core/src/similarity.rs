//! Measures how similar a sentence is to a known instruction, by their word embeddings alone.
//!
//! A policy follows any words, and what it does with words that it was not trained on is not known;
//! so a caller of `Instruction::Words` first compares them with the known instructions and requires
//! the similarity that the bundle's contract states (`language.acceptance`). Pure functions on
//! slices: they allocate nothing and cannot fail; invalid input has the lowest similarity.
//!
//! Words are compared, not meanings: "do not open the drawer" is much like "open the drawer".

use lads_kernels::math::sqrt;

/// Similarity of input that cannot be compared: no word, a length that is not a multiple of the
/// word dimension, or an element that is not finite.
pub const UNLIKE: f32 = -1.0;

/// Returns the similarity of a sentence to a known instruction, from -1 to 1; both are word
/// embeddings `[n, dim]`, row by row.
///
/// Every word of the sentence is compared with the word of the known instruction that is most like
/// it, by the cosine; the result is the mean over the sentence's words. The last of several words
/// is the encoder's end mark, which stands in every sentence, and is left out. For an encoder that
/// maps a sentence to one word, this is the cosine of the two.
///
/// The contract calls it `alignment`. It is not symmetric: words of the instruction that the
/// sentence omits do not count.
#[must_use]
pub fn alignment(sentence: &[f32], known: &[f32], dim: usize) -> f32 {
    let (Some(sentence), Some(known)) = (spoken(sentence, dim), spoken(known, dim)) else {
        return UNLIKE;
    };
    let (mut sum, mut count) = (0.0_f32, 0.0_f32);
    for word in sentence.chunks_exact(dim) {
        let alike = known.chunks_exact(dim).map(|other| cosine(word, other));
        sum += alike.fold(UNLIKE, f32::max);
        count += 1.0;
    }
    sum / count
}

/// Returns the position of the known instruction that a sentence is most similar to, the first of
/// equal ones, and its [`alignment`]; `None` if none is known.
#[must_use]
pub fn nearest<'w>(
    sentence: &[f32],
    known: impl IntoIterator<Item = &'w [f32]>,
    dim: usize,
) -> Option<(usize, f32)> {
    let mut best: Option<(usize, f32)> = None;
    for (place, words) in known.into_iter().enumerate() {
        let alike = alignment(sentence, words, dim);
        if best.is_none_or(|(_, most)| alike > most) {
            best = Some((place, alike));
        }
    }
    best
}

/// Returns the words without the end mark; `None` if they are invalid.
fn spoken(words: &[f32], dim: usize) -> Option<&[f32]> {
    let whole = !words.is_empty() && words.len().checked_rem(dim) == Some(0);
    if !whole || words.iter().any(|x| !x.is_finite()) {
        return None;
    }
    let end = words.len().saturating_sub(dim);
    words.get(..if end == 0 { dim } else { end })
}

/// Returns the cosine of two vectors, 0 if one of them is zero; within -1 and 1.
fn cosine(a: &[f32], b: &[f32]) -> f32 {
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
    let lengths = sqrt(dot(a, a)) * sqrt(dot(b, b));
    let cosine = dot(a, b) / lengths;
    // Also where the squares leave the range of numbers.
    if lengths > 0.0 && cosine.is_finite() {
        cosine.clamp(-1.0, 1.0)
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const X: [f32; 2] = [2.0, 0.0];
    const Y: [f32; 2] = [0.0, 3.0];
    const END: [f32; 2] = [9.0, 9.0];

    fn close(got: f32, wanted: f32) {
        assert!((got - wanted).abs() < 1e-6, "{got} instead of {wanted}");
    }

    #[test]
    fn every_word_counts_by_the_one_most_like_it() {
        let (both, turned) = ([X, Y, END].concat(), [Y, X, END].concat());
        close(alignment(&both, &turned, 2), 1.0);
        let one = [X, END].concat();
        close(alignment(&both, &one, 2), 0.5);
        close(alignment(&one, &both, 2), 1.0);
    }

    #[test]
    fn one_word_alone_is_no_end_mark() {
        close(alignment(&X, &[2.0, 2.0], 2), 0.5_f32.sqrt());
        close(alignment(&X, &[-1.0, 0.0], 2), -1.0);
        close(alignment(&X, &Y, 2), 0.0);
    }

    #[test]
    fn what_cannot_be_compared_is_unlike() {
        let bad: [(&[f32], usize); 6] = [
            (&[], 2),
            (&X, 0),
            (&X, 3),
            (&[1.0, 2.0, 3.0], 2),
            (&[f32::NAN, 1.0], 2),
            (&[f32::INFINITY, 1.0, 9.0, 9.0], 2),
        ];
        for (words, dim) in bad {
            assert_eq!(alignment(words, &X, dim), UNLIKE, "{words:?}");
            assert_eq!(alignment(&X, words, dim), UNLIKE, "{words:?}");
        }
        assert_eq!(alignment(&[0.0, 0.0], &X, 2), 0.0);
        assert_eq!(alignment(&[1e30, 0.0], &[1e30, 0.0], 2), 0.0);
    }

    #[test]
    fn the_nearest_is_the_first_of_the_most_alike() {
        let known: [&[f32]; 3] = [&Y, &X, &[4.0, 0.0]];
        assert_eq!(nearest(&X, known, 2), Some((1, 1.0)));
        assert_eq!(nearest(&[], known, 2), Some((0, UNLIKE)));
        assert_eq!(nearest(&X, core::iter::empty(), 2), None);
    }
}
