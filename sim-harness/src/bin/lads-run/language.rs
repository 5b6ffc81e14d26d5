//! Chooses the instructions of a run: those of the bundle's table, or, through the language encoder (cargo feature `language`), any
//! sentence.

use lads_compiler::Bundle;
use lads_core::Policy;
use lads_sim::environment::Environment;
use lads_sim::results::{self, Asked, HeardBy, NearestKnown, Results};
use lads_sim::spoken::{self, Sentence, Unaccepted, WordBook};

use crate::arguments::Wanted;
use crate::end::{End, refused};

/// The instructions that were asked for.
pub enum Chosen {
    /// All instructions of the bundle's table.
    All,
    /// Some instructions of the bundle's table, by index.
    Known(Vec<u32>),
    /// A sentence outside the bundle's table.
    Sentence(String),
}

impl Chosen {
    /// Reads `--instruction`, and refuses what cannot go with it.
    pub fn of(wanted: &Wanted<'_>, bundle: &Bundle) -> Result<Self, End> {
        let language = wanted.language;
        let Some(text) = wanted.instruction else {
            return match &language.sub_tasks {
                None => Ok(Self::All),
                Some(_) => Err(refused(
                    "--sub-tasks: they judge a sentence; give it with --instruction",
                )),
            };
        };
        if text.trim().is_empty() {
            return Err(refused(format!(
                "--instruction '{}': an empty sentence; say what is to be done",
                text.escape_debug()
            )));
        }
        let found = bundle.instruction_indices(text);
        if found.is_empty() {
            if let Some(of_table) = wanted.of_table {
                return Err(refused(format!(
                    "{of_table}: for instructions of the bundle's table, and '{text}' is not one{}",
                    nearest_texts(bundle, text)
                )));
            }
            if wanted.judged && language.sub_tasks.is_none() {
                return Err(refused(
                    "sweep: a sentence outside the bundle's table has no N-rate; name what it is judged by with --sub-tasks",
                ));
            }
            return Ok(Self::Sentence(text.to_owned()));
        }
        if language.sub_tasks.is_some() {
            return Err(refused(format!(
                "--sub-tasks: '{text}' is in the bundle's table, with its own; leave --sub-tasks out"
            )));
        }
        Ok(Self::Known(
            found.into_iter().map(|index| index as u32).collect(),
        ))
    }

    /// Whether this choice includes `instruction` of the bundle's table.
    pub fn has(&self, instruction: u32) -> bool {
        match self {
            Self::All => true,
            Self::Known(all) => all.contains(&instruction),
            Self::Sentence(_) => false,
        }
    }

    /// Returns the sentence outside the table, with the sub-tasks that it is judged by.
    pub fn sentence(
        &self,
        wanted: &Wanted<'_>,
        environment: &dyn Environment,
    ) -> Result<Option<Sentence>, End> {
        let Self::Sentence(text) = self else {
            return Ok(None);
        };
        let sub_tasks = wanted.language.sub_tasks.as_deref();
        let sentence = Sentence::new(text, sub_tasks, environment);
        sentence
            .map(Some)
            .map_err(|error| refused(format!("--sub-tasks: {error}")))
    }
}

fn nearest_texts(bundle: &Bundle, wanted: &str) -> String {
    let nearest = bundle.nearest_instructions(wanted);
    let nearest: Vec<_> = nearest.iter().map(|text| format!("'{text}'")).collect();
    format!(" (the nearest that it knows: {})", nearest.join(", "))
}

/// Word embeddings made by the language encoder for this run.
pub struct Heard<'p> {
    /// Embeddings by instruction.
    pub words: WordBook,
    /// The encoder that made the embeddings, for results; `None` where all come from the table.
    pub by: Option<HeardBy>,
    /// The known instruction that a sentence outside the table is most like.
    pub nearest: Option<Asked<'p>>,
    /// Text to print before the sentence is followed.
    pub first: String,
    /// Text to print after the run.
    pub note: String,
}

impl Heard<'_> {
    /// Returns the text to print after the run, with what a sentence that names no sub-tasks has completed.
    pub fn last(&self, results: &Results) -> String {
        let unjudged = self.words.sentence.as_ref();
        let unjudged = unjudged.is_some_and(|sentence| sentence.asked().sub_tasks.is_empty());
        let result = results.instructions.first().filter(|_| unjudged);
        let completed = self.nearest.as_ref().zip(result);
        let completed = completed
            .map(|(nearest, result)| format!("\n{}\n", spoken::completed(nearest, result)));
        format!("{}{}", self.note, completed.unwrap_or_default())
    }
}

/// Encodes what the table does not have, or, with `--encode-language`, every instruction.
pub fn hear<'p>(
    wanted: &Wanted<'_>,
    bundle: &'p Bundle,
    policy: &Policy<'_>,
    chosen: &Chosen,
) -> Result<Heard<'p>, End> {
    match chosen {
        Chosen::Sentence(text) => hear_sentence(wanted, bundle, policy, text),
        _ if wanted.language.encode_language => hear_again(wanted, bundle, policy, chosen),
        _ => Ok(Heard {
            words: WordBook::default(),
            by: None,
            nearest: None,
            first: String::new(),
            note: String::new(),
        }),
    }
}

fn hear_sentence<'p>(
    wanted: &Wanted<'_>,
    bundle: &'p Bundle,
    policy: &Policy<'_>,
    text: &str,
) -> Result<Heard<'p>, End> {
    let not_known = || {
        format!(
            "--instruction '{text}': not in the bundle's table{}",
            nearest_texts(bundle, text)
        )
    };
    let encoder = encoder::open(wanted, bundle)
        .map_err(|wrong| refused(format!("{}: {wrong}", not_known())))?;
    let heard = encoder::words(&encoder, text)
        .map_err(|wrong| refused(format!("--instruction {wrong}")))?;
    let contract = policy.contract();
    let nearest = spoken::nearest(contract, &heard).and_then(|(place, similarity)| {
        Some((results::asked(bundle.contract(), place)?, similarity))
    });
    let (nearest, similarity) = nearest.ok_or_else(|| {
        refused(format!(
            "{}: no instruction to compare it with",
            not_known()
        ))
    })?;
    let acceptance = bundle.contract().language.as_ref();
    let acceptance = acceptance.and_then(|language| language.acceptance.as_ref());
    let accepted = spoken::accept(acceptance, similarity);
    let shown = text.escape_debug();
    let near = format!(
        "the nearest known instruction is '{}' ({}), similarity {similarity:.3}",
        nearest.text, nearest.id
    );
    let first = match accepted {
        Ok(()) => format!("'{shown}': {near}\n\n"),
        Err(why) if wanted.language.sentence_anyway => {
            format!("'{shown}': {near}; {why}: followed because of --sentence-anyway\n\n")
        }
        Err(why) => {
            let remedy = match why {
                Unaccepted::Below { .. } => "say it in words that are more like a known one",
                Unaccepted::Uncalibrated => "export it with a calibration",
            };
            return Err(refused(format!(
                "--instruction '{shown}': {near}; {why}; {remedy}, or insist with --sentence-anyway"
            )));
        }
    };
    let mut words = WordBook::default();
    words.set(contract.instruction_count() as u32, heard);
    let known = NearestKnown {
        id: nearest.id.to_owned(),
        text: nearest.text.to_owned(),
        similarity,
        threshold: acceptance.map(|acceptance| acceptance.threshold),
        accepted: accepted.is_ok(),
    };
    Ok(Heard {
        words,
        by: Some(heard_by(bundle, None, Some(known))),
        nearest: Some(nearest),
        first,
        note: String::new(),
    })
}

fn hear_again<'p>(
    wanted: &Wanted<'_>,
    bundle: &'p Bundle,
    policy: &Policy<'_>,
    chosen: &Chosen,
) -> Result<Heard<'p>, End> {
    let about = |wrong: String| refused(format!("--encode-language: {wrong}"));
    let encoder = encoder::open(wanted, bundle).map_err(about)?;
    let mut words = WordBook::default();
    let (mut count, mut largest) = (0, 0.0_f32);
    for (instruction, known) in (0..).zip(policy.contract().instructions()) {
        if !chosen.has(instruction) {
            continue;
        }
        let heard = encoder::words(&encoder, known.text).map_err(about)?;
        if heard.len() != known.words.len() {
            return Err(about(format!(
                "'{}' has {} numbers in the table, {} by the encoder; export the bundle again",
                known.text,
                known.words.len(),
                heard.len()
            )));
        }
        let pairs = heard.iter().zip(known.words);
        largest = pairs.map(|(a, b)| (a - b).abs()).fold(largest, f32::max);
        words.set(instruction, heard);
        count += 1;
    }
    let note = format!(
        "\n{count} instructions heard by the language encoder; largest difference from the bundle's table {largest:.1e}\n"
    );
    Ok(Heard {
        words,
        by: Some(heard_by(bundle, Some(largest), None)),
        nearest: None,
        first: String::new(),
        note,
    })
}

fn heard_by(
    bundle: &Bundle,
    largest_difference: Option<f32>,
    nearest: Option<NearestKnown>,
) -> HeardBy {
    let language = bundle.contract().language.as_ref();
    HeardBy {
        encoder: language.map_or_else(String::new, |it| it.encoder.clone()),
        sha256: language.map_or_else(String::new, |it| it.sha256.clone()),
        largest_difference,
        nearest,
    }
}

/// The language encoder.
#[cfg(feature = "language")]
mod encoder {
    use lads_compiler::Bundle;
    pub use lads_language::Encoder;
    use lads_language::default_folder;

    use crate::arguments::Wanted;

    pub fn open(wanted: &Wanted<'_>, bundle: &Bundle) -> Result<Encoder, String> {
        let contract = bundle.contract();
        let named = wanted.language.encoder.clone();
        let language = contract.language.as_ref();
        let language = language.ok_or("the policy takes no instructions in words")?;
        let folder = named.map_or_else(|| default_folder(&language.encoder), Ok);
        let encoder = folder.and_then(|folder| Encoder::open(&folder, contract));
        encoder.map_err(|error| error.to_string())
    }

    pub fn words(encoder: &Encoder, text: &str) -> Result<Vec<f32>, String> {
        encoder.words(text).map_err(|error| error.to_string())
    }
}

/// Stand-in for builds without the language encoder.
#[cfg(not(feature = "language"))]
mod encoder {
    use lads_compiler::Bundle;

    use crate::arguments::Wanted;

    pub enum Encoder {}

    pub fn open(_: &Wanted<'_>, _: &Bundle) -> Result<Encoder, String> {
        Err("this lads-run was built without the language encoder; run \"make say\", or build it with \"cargo build --release -p lads-sim --features language\"".to_owned())
    }

    pub fn words(encoder: &Encoder, _: &str) -> Result<Vec<f32>, String> {
        match *encoder {}
    }
}
