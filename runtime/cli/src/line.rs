//! Reads and writes one observation or action per line of text: comma-separated values, or a JSON
//! array of numbers.
//!
//! Numbers have the shortest decimal form that gives the same f32 back, so a pipe loses nothing.
//! What can fail: a value is not a number or not finite, or there are too many or too few; the
//! error names the element, counted from 1.

use std::fmt::Write as _;

/// Format of a line; an action is answered in the format of its observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// Comma-separated values, `0.1,0.2,0.3`.
    Csv,
    /// JSON array, `[0.1,0.2,0.3]`.
    Json,
}

/// Reason why a line is not an observation.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LineError {
    /// The number of values is wrong.
    #[error("{got} values, the contract has {expected}")]
    Count {
        /// Number of values on the line.
        got: usize,
        /// Number of values in an observation.
        expected: usize,
    },
    /// A value that is not a number.
    #[error("value {position} is '{text}', not a number")]
    NotANumber {
        /// Position of the value on the line, from 1.
        position: usize,
        /// Text at that position, shortened.
        text: String,
    },
    /// A value is NaN or infinite, also by overflow of f32.
    #[error("value {position} is '{text}', not finite")]
    NotFinite {
        /// Position of the value on the line, from 1.
        position: usize,
        /// Text at that position, shortened.
        text: String,
    },
    /// A JSON array without its closing bracket, or something after it.
    #[error("a JSON array that does not end in ']'")]
    Unclosed,
}

/// Reads the values of `line` into `values`, which has the expected length.
pub fn parse(line: &str, values: &mut [f32]) -> Result<Form, LineError> {
    let line = line.trim();
    let (form, body) = match line.strip_prefix('[') {
        Some(rest) => (
            Form::Json,
            rest.strip_suffix(']').ok_or(LineError::Unclosed)?,
        ),
        None => (Form::Csv, line),
    };
    let expected = values.len();
    let fields = || body.split(',').map(str::trim);
    let got = if body.trim().is_empty() {
        0
    } else {
        fields().count()
    };
    // The count first: it is the mistake of the two that explains the other.
    if got != expected {
        return Err(LineError::Count { got, expected });
    }
    for ((position, text), value) in (1..).zip(fields()).zip(values) {
        let shortened = || text.chars().take(24).collect::<String>();
        *value = text.parse().map_err(|_| LineError::NotANumber {
            position,
            text: shortened(),
        })?;
        if !value.is_finite() {
            return Err(LineError::NotFinite {
                position,
                text: shortened(),
            });
        }
    }
    Ok(form)
}

/// Writes `values`, and the plan index after them if given, as one line into `out`, which is cleared first.
pub fn format(form: Form, values: &[f32], plan: Option<u32>, out: &mut String) {
    out.clear();
    if form == Form::Json {
        out.push('[');
    }
    for (place, value) in values.iter().enumerate() {
        let comma = if place == 0 { "" } else { "," };
        // Writing to a String cannot fail.
        let _ = write!(out, "{comma}{value}");
    }
    if let Some(plan) = plan {
        let _ = write!(out, ",{plan}");
    }
    out.push_str(if form == Form::Json { "]\n" } else { "\n" });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn csv_and_json_give_the_same_values() {
        let (mut csv, mut json) = ([0.0; 3], [0.0; 3]);
        assert_eq!(parse(" 0.5, -1e-3 ,2\r\n", &mut csv), Ok(Form::Csv));
        assert_eq!(parse("[0.5, -0.001, 2]\n", &mut json), Ok(Form::Json));
        assert_eq!((csv, json), ([0.5, -0.001, 2.0], [0.5, -0.001, 2.0]));
    }

    #[test]
    fn what_is_written_reads_back_bit_for_bit() {
        let values = [0.1_f32, -1.0 / 3.0, 1e-38, 3.4e38, -0.0];
        for form in [Form::Csv, Form::Json] {
            let (mut text, mut back) = (String::from("old"), [1.0; 5]);
            format(form, &values, None, &mut text);
            assert_eq!(parse(&text, &mut back), Ok(form));
            assert_eq!(back.map(f32::to_bits), values.map(f32::to_bits), "{text}");
        }
    }

    #[test]
    fn the_plan_comes_last() {
        let mut text = String::new();
        format(Form::Csv, &[0.5, 1.0], Some(7), &mut text);
        assert_eq!(text, "0.5,1,7\n");
        format(Form::Json, &[0.5], Some(0), &mut text);
        assert_eq!(text, "[0.5,0]\n");
    }

    #[test]
    fn mistakes_are_named() {
        let mut values = [0.0; 2];
        let mut error = |line| parse(line, &mut values).unwrap_err().to_string();
        assert_eq!(error("1"), "1 values, the contract has 2");
        assert_eq!(error("1,2,"), "3 values, the contract has 2");
        assert_eq!(error("[]"), "0 values, the contract has 2");
        assert_eq!(error("1,nan"), "value 2 is 'nan', not finite");
        assert_eq!(error("1e99,0"), "value 1 is '1e99', not finite");
        assert_eq!(error("[1,null]"), "value 2 is 'null', not a number");
        assert_eq!(error("[1,2"), "a JSON array that does not end in ']'");
        assert_eq!(error("1,"), "value 2 is '', not a number");
    }
}
