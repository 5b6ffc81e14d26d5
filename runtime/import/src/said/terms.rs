//! Reads what metadata say of each observation term, in the order of `observation_names`: its scale, clip and history.
//!
//! What can fail: there is not one value for each term, or one that cannot be followed as it stands; each is a problem with its name, which a
//! person settles by saying that field of the term.

use super::Said;
use crate::problem::Problems;
use crate::robot::{Clip, Each, History, Layout, Order, Start, Term};
use crate::yaml::Value;

const SCALE: &str = "observation_terms_scale";
const CLIP: &str = "observation_terms_clip";
const LENGTH: &str = "observation_terms_history_length";
const FLATTENED: &str = "observation_terms_flatten_history_dim";

/// Writes them into the terms that were read; `own` are the terms as a person described them.
pub(super) fn read(
    said: &mut Said,
    values: &Value,
    own: &[Term],
    source: &str,
    problems: &mut Problems,
) {
    let count = said.robot.terms.len();
    let used = &mut said.used;
    let mut rows = |name: &str| {
        let value = values.get(name)?;
        used.push(name.into());
        let one = std::slice::from_ref(value);
        let rows: Option<Vec<Vec<f64>>> = value.list().unwrap_or(one).iter().map(numbers).collect();
        let rows = rows.filter(|rows| rows.len() == count);
        let settled = !own.is_empty() && own.iter().all(|term| says(term, name));
        if rows.is_none() && !settled {
            let wrong = format!(
                "does not have numbers for each of the {count} terms of `observation_names`; say that field of each term in the description"
            );
            problems.add(format!("{source}, `{name}`"), wrong);
        }
        rows
    };
    let (scales, clips) = (rows(SCALE), rows(CLIP));
    let (lengths, flattened) = (rows(LENGTH), rows(FLATTENED));
    let of = |rows: &Option<Vec<Vec<f64>>>, at: usize| -> Vec<f64> {
        let row = rows.as_ref().and_then(|rows| rows.get(at));
        row.cloned().unwrap_or_default()
    };
    let mut remembers = false;
    for (at, term) in said.robot.terms.iter_mut().enumerate() {
        let mut refuse = |name: &str, wrong: &str| {
            let about = format!("{source}, `{name}`, {}", term.name);
            problems.add(
                about,
                format!("{wrong}; say that field of the term in the description"),
            );
        };
        let (scale, clip) = (scaled(&of(&scales, at)), clipped(&of(&clips, at)));
        let steps = match of(&lengths, at)[..] {
            [] => Ok(None),
            [steps] if steps.fract() == 0.0 && (0.0..=1e6).contains(&steps) => {
                Ok(Some(steps as usize).filter(|&steps| steps > 1))
            }
            _ => Err("is no whole number of steps"),
        };
        let is_flat = of(&flattened, at) != [0.0];
        let steps = steps.and_then(|steps| match steps {
            Some(_) if !is_flat => Err("is of a history that is not flattened"),
            steps => Ok(steps),
        });
        for (name, fault) in [
            (SCALE, scale.as_ref().err()),
            (CLIP, clip.as_ref().err()),
            (LENGTH, steps.as_ref().err()),
        ] {
            if let Some(wrong) = fault
                && !own.get(at).is_some_and(|term| says(term, name))
            {
                refuse(name, wrong);
            }
        }
        remembers |= matches!(steps, Ok(Some(_)));
        write(
            term,
            scale.ok().flatten(),
            clip.ok().flatten(),
            steps.ok().flatten(),
        );
    }
    if remembers {
        said.robot.history = Some(History {
            length: None,
            layout: Some(Layout::Term),
            order: Some(Order::OldestFirst),
            start: Some(Start::First),
        });
    }
}

/// Returns whether a person's description has what a name of the metadata says.
fn says(term: &Term, name: &str) -> bool {
    match name {
        SCALE => term.scale.is_some(),
        CLIP => term.clip.is_some(),
        _ => term.history.is_some(),
    }
}

fn write(term: &mut Term, scale: Option<Each>, clip: Option<Clip>, steps: Option<usize>) {
    (term.scale, term.clip, term.history) = (scale, clip, steps);
}

/// Reads an entry: a number, several that are joined by semicolons or a list, or nothing.
fn numbers(value: &Value) -> Option<Vec<f64>> {
    match value {
        Value::Null => Some(vec![]),
        Value::Bool(flag) => Some(vec![f64::from(u8::from(*flag))]),
        Value::Number(number) => Some(vec![*number]),
        Value::List(_) => value.numbers(),
        Value::Text(text) => match text.as_str() {
            "None" | "" => Some(vec![]),
            "True" => Some(vec![1.0]),
            "False" => Some(vec![0.0]),
            text => text
                .split(';')
                .map(|part| part.trim().parse().ok())
                .collect(),
        },
        Value::Map(_) => None,
    }
}

/// Returns a scale; `None` where it changes nothing.
fn scaled(values: &[f64]) -> Result<Option<Each>, &'static str> {
    match values {
        [] => Ok(None),
        _ if values.iter().any(|value| !value.is_finite()) => Err("is not finite"),
        _ if values.iter().all(|&value| value == 1.0) => Ok(None),
        &[value] => Ok(Some(Each::One(value))),
        _ => Ok(Some(Each::Many(values.to_vec()))),
    }
}

/// Returns a clip; `None` where it has no bounds.
fn clipped(values: &[f64]) -> Result<Option<Clip>, &'static str> {
    match values {
        [] => Ok(None),
        &[low, high] if low == f64::NEG_INFINITY && high == f64::INFINITY => Ok(None),
        &[low, high] if low.is_finite() && high.is_finite() => {
            Ok(Some(Clip::Between([Each::One(low), Each::One(high)])))
        }
        [_, _] => Err("has one bound that is not finite"),
        _ => Err("is no pair of bounds"),
    }
}

#[cfg(test)]
mod tests {
    use super::super::metadata;
    use super::*;

    fn read(pairs: &[(&str, &str)]) -> (Said, String) {
        read_beside(&[], pairs)
    }

    fn read_beside(own: &[Term], pairs: &[(&str, &str)]) -> (Said, String) {
        let mut problems = Problems::default();
        let names = [("observation_names", "base_ang_vel,joint_pos")];
        let said = metadata(
            names.into_iter().chain(pairs.iter().copied()),
            own,
            &mut problems,
        );
        (said, problems.to_string())
    }

    #[test]
    fn what_is_said_of_each_term_is_followed() {
        let (said, problems) = read(&[
            (SCALE, "0.25,1.0"),
            (CLIP, "-1.0;1.0,-inf;inf"),
            (LENGTH, "3,0"),
            (FLATTENED, "True,True"),
        ]);
        assert_eq!(problems, "");
        let [first, second] = &said.robot.terms[..] else {
            panic!("two terms");
        };
        assert_eq!(first.scale, Some(Each::One(0.25)));
        let clip = Clip::Between([Each::One(-1.0), Each::One(1.0)]);
        assert_eq!((&first.clip, first.history), (&Some(clip), Some(3)));
        assert_eq!(
            (&second.scale, &second.clip, second.history),
            (&None, &None, None)
        );
        let history = said.robot.history.expect("a term has one");
        assert_eq!(history.layout, Some(Layout::Term));
        // A scale for each element, as JSON and joined by semicolons.
        for scale in ["[[2.0, 3.0], 1.0]", "2.0;3.0,1.0"] {
            let (said, problems) = read(&[(SCALE, scale)]);
            assert_eq!(problems, "");
            let wanted = Some(Each::Many(vec![2.0, 3.0]));
            assert_eq!(said.robot.terms[0].scale, wanted, "{scale}");
        }
    }

    #[test]
    fn what_cannot_be_followed_is_a_problem_with_its_name() {
        for (name, text, wrong) in [
            (SCALE, "0.25", "for each of the 2 terms"),
            (SCALE, "[1.0,2.0],1.0", "for each of the 2 terms"),
            (SCALE, "nan,1.0", "base_ang_vel: is not finite"),
            (CLIP, "-1.0;inf,-inf;inf", "one bound"),
            (CLIP, "-1.0,1.0", "is no pair"),
            (LENGTH, "2.5,0", "no whole number"),
        ] {
            let (_, problems) = read(&[(name, text)]);
            assert!(problems.contains(wrong), "{name} = {text}: {problems}");
            assert!(problems.contains(name), "{problems}");
        }
        let (_, problems) = read(&[(LENGTH, "2,0"), (FLATTENED, "False,True")]);
        assert!(problems.contains("not flattened"), "{problems}");
        // What a person says of the terms settles it, and of one term that alone.
        let term = |clip: Option<Clip>| Term {
            scale: Some(Each::One(1.0)),
            clip,
            ..Term::default()
        };
        let own = [term(Some(Clip::Around(5.0))), term(None)];
        let unreadable = [(SCALE, "[1.0,2.0],1.0"), (CLIP, "-1.0;inf,-inf;inf")];
        assert_eq!(read_beside(&own, &unreadable).1, "");
        let (_, problems) = read_beside(&own, &[(CLIP, "-inf;inf,-1.0;inf")]);
        assert!(problems.contains("joint_pos: has one bound"), "{problems}");
    }
}
