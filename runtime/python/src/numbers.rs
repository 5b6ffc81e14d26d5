//! Whole numbers and rows that Python gives, checked by `lads/_numbers.py`.
//!
//! A number of an argument's own type would be refused by an exception that does not name the
//! argument. What can fail: another type (`TypeError`), a number outside the limits (`InputError`).

use pyo3::PyTypeInfo;
use pyo3::prelude::*;
use pyo3::types::PyInt;

/// Returns the whole number from `least` to `most` given for the argument `name`.
pub fn whole(given: &Bound<'_, PyAny>, name: &str, least: u64, most: u64) -> PyResult<u64> {
    // The usual case without a call into Python: an int in its limits, which no bool is exactly.
    if given.is_exact_instance_of::<PyInt>()
        && let Ok(number) = given.extract::<u64>()
        && (least..=most).contains(&number)
    {
        return Ok(number);
    }
    let checked = given.py().import("lads._numbers")?;
    checked
        .call_method1("whole", (name, given, least, most))?
        .extract()
}

/// Returns the seed given for the argument `name`, if one was given.
pub fn seed(given: Option<&Bound<'_, PyAny>>, name: &str) -> PyResult<Option<u64>> {
    given
        .map(|given| whole(given, name, 0, u64::MAX))
        .transpose()
}

/// Returns the finite number above 0 given for the argument `name`; another one is an `E`.
pub fn real<E: PyTypeInfo>(given: &Bound<'_, PyAny>, name: &str) -> PyResult<f64> {
    let (py, error) = (given.py(), given.py().get_type::<E>());
    let checked = py.import("lads._numbers")?;
    checked
        .call_method1("real", (name, given, error))?
        .extract()
}

/// Returns the rows of a batch of `count` rows: all, or those given.
pub fn rows(given: Option<&Bound<'_, PyAny>>, count: usize) -> PyResult<Vec<usize>> {
    let Some(given) = given else {
        return Ok((0..count).collect());
    };
    let checked = given.py().import("lads._numbers")?;
    checked.call_method1("rows", (given, count))?.extract()
}
