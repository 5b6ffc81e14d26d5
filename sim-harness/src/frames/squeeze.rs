//! A picture made smaller: every pixel is the mean of what it covers, in whole numbers, so that it has the same bits everywhere.

/// Fills `to` (`size` rows and columns of three bytes) with means over `from` (`drawn` rows and columns, no fewer).
pub(super) fn squeeze(from: &[u8], drawn: [u32; 2], size: [u32; 2], to: &mut [u8]) {
    let [rows, columns] = size.map(|side| side as usize);
    let [drawn_rows, drawn_columns] = drawn.map(|side| side as usize);
    // In units of which a drawn pixel has `rows` by `columns`, a pixel of the frame covers `drawn_rows` by `drawn_columns`.
    let whole = (drawn_rows * drawn_columns) as u64;
    for (place, pixel) in to.chunks_exact_mut(3).enumerate() {
        let (row, column) = (place / columns, place % columns);
        let mut sums = [whole / 2; 3];
        for (from_row, high) in covered(row, rows, drawn_rows) {
            for (from_column, wide) in covered(column, columns, drawn_columns) {
                let at = 3 * (from_row * drawn_columns + from_column);
                let seen = from.get(at..at + 3).unwrap_or(&[0; 3]);
                for (sum, &value) in sums.iter_mut().zip(seen) {
                    *sum += u64::from(value) * (high * wide) as u64;
                }
            }
        }
        for (value, sum) in pixel.iter_mut().zip(sums) {
            *value = (sum / whole) as u8;
        }
    }
}

/// The drawn pixels along an axis that pixel `i` of `len` covers, and how much of each.
fn covered(i: usize, len: usize, drawn: usize) -> impl Iterator<Item = (usize, usize)> {
    let (begin, end) = (i * drawn, (i + 1) * drawn);
    (begin / len..end.div_ceil(len)).map(move |at| {
        let share = end.min((at + 1) * len) - begin.max(at * len);
        (at, share)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_are_means_of_what_they_cover() {
        // Three columns into two: each takes one whole and a half of the middle.
        let from = [0, 0, 0, 30, 60, 90, 90, 90, 255];
        let mut to = [0; 6];
        squeeze(&from, [1, 3], [1, 2], &mut to);
        assert_eq!(to, [10, 20, 30, 70, 80, 200]);
    }

    #[test]
    fn a_picture_of_one_colour_stays_so() {
        let from = [200; 5 * 7 * 3];
        let mut to = [0; 3 * 4 * 3];
        squeeze(&from, [5, 7], [3, 4], &mut to);
        assert_eq!(to, [200; 36]);
    }
}
