//! What the policy is told: instructions of the bundle's table, or, through the language encoder (cargo feature `language`), any sentence.

use lads_compiler::Bundle;
use lads_core::Policy;
use lads_sim::environment::Environment;
use lads_sim::results::HeardBy;
use lads_sim::spoken::{Sentence, WordBook, nearest};

use crate::arguments::Arguments;
use crate::end::{End, refused};

/// What was asked for.
pub enum Chosen {
    /// All instructions of the table.
    All,
    /// These of its instructions.
    Known(Vec<u32>),
    /// A sentence outside the table.
    Sentence(String),
}

impl Chosen {
    /// Reads `--instruction`, and refuses what cannot go with it.
    pub fn of(arguments: &Arguments, bundle: &Bundle) -> Result<Self, End> {
        let language = &arguments.language;
        let Some(wanted) = &arguments.instruction else {
            return match language.sub_tasks {
                None => Ok(Self::All),
                Some(_) => Err(refused(
                    "--sub-tasks: they judge a sentence; give it with --instruction",
                )),
            };
        };
        if wanted.trim().is_empty() {
            return Err(refused(format!(
                "--instruction '{}': an empty sentence; say what is to be done",
                wanted.escape_debug()
            )));
        }
        let found = bundle.instruction_indices(wanted);
        if found.is_empty() {
            let others = [
                ("--verify", arguments.verify.is_some()),
                ("--plans", arguments.recordings.plans.is_some()),
                ("--report", arguments.report.is_some()),
            ];
            if let Some((option, _)) = others.iter().find(|(_, given)| *given) {
                return Err(refused(format!(
                    "{option}: for instructions of the bundle's table, and '{wanted}' is none{}; leave {option} out",
                    nearest_texts(bundle, wanted)
                )));
            }
            if arguments.faults.sweep && language.sub_tasks.is_none() {
                return Err(refused(
                    "--sweep: a sentence outside the bundle's table has no N-rate; name what it is judged by with --sub-tasks",
                ));
            }
            return Ok(Self::Sentence(wanted.clone()));
        }
        if language.sub_tasks.is_some() {
            return Err(refused(format!(
                "--sub-tasks: '{wanted}' is in the bundle's table, with its own; leave --sub-tasks out"
            )));
        }
        Ok(Self::Known(
            found.into_iter().map(|index| index as u32).collect(),
        ))
    }

    /// Whether an instruction of the table is among them.
    pub fn has(&self, instruction: u32) -> bool {
        match self {
            Self::All => true,
            Self::Known(all) => all.contains(&instruction),
            Self::Sentence(_) => false,
        }
    }

    /// The sentence outside the table, with what it is judged by.
    pub fn sentence(
        &self,
        arguments: &Arguments,
        environment: &dyn Environment,
    ) -> Result<Option<Sentence>, End> {
        let Self::Sentence(text) = self else {
            return Ok(None);
        };
        let sub_tasks = arguments.language.sub_tasks.as_deref();
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

/// What was heard through the language encoder.
pub struct Heard {
    /// The embeddings.
    pub words: WordBook,
    /// Who heard them, for results; `None` where all come from the table.
    pub by: Option<HeardBy>,
    /// What a person wants to know of it.
    pub note: String,
}

/// Lets the language encoder hear what the table does not have, or, with `--encode-language`, everything.
pub fn hear(
    arguments: &Arguments,
    bundle: &Bundle,
    policy: &Policy<'_>,
    chosen: &Chosen,
) -> Result<Heard, End> {
    match chosen {
        Chosen::Sentence(text) => hear_sentence(arguments, bundle, policy, text),
        _ if arguments.language.encode_language => hear_again(arguments, bundle, policy, chosen),
        _ => Ok(Heard {
            words: WordBook::default(),
            by: None,
            note: String::new(),
        }),
    }
}

fn hear_sentence(
    arguments: &Arguments,
    bundle: &Bundle,
    policy: &Policy<'_>,
    text: &str,
) -> Result<Heard, End> {
    let not_known = || {
        format!(
            "--instruction '{text}': not in the bundle's table{}",
            nearest_texts(bundle, text)
        )
    };
    let encoder = encoder::open(arguments, bundle)
        .map_err(|wrong| refused(format!("{}: {wrong}", not_known())))?;
    let heard = encoder::words(&encoder, text)
        .map_err(|wrong| refused(format!("--instruction {wrong}")))?;
    let contract = policy.contract();
    let note = nearest(&contract, &heard).map_or_else(String::new, |(known, cosine)| {
        format!(
            "\n'{text}' is heard most like '{}' ({}), cosine {cosine:.2}\n",
            known.text, known.id
        )
    });
    let mut words = WordBook::default();
    words.set(contract.instruction_count() as u32, heard);
    let by = Some(heard_by(bundle, None));
    Ok(Heard { words, by, note })
}

fn hear_again(
    arguments: &Arguments,
    bundle: &Bundle,
    policy: &Policy<'_>,
    chosen: &Chosen,
) -> Result<Heard, End> {
    let about = |wrong: String| refused(format!("--encode-language: {wrong}"));
    let encoder = encoder::open(arguments, bundle).map_err(about)?;
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
    let by = Some(heard_by(bundle, Some(largest)));
    Ok(Heard { words, by, note })
}

fn heard_by(bundle: &Bundle, largest_difference: Option<f32>) -> HeardBy {
    let language = &bundle.contract().language;
    HeardBy {
        encoder: language.encoder.clone(),
        sha256: language.sha256.clone(),
        largest_difference,
    }
}

/// The encoder itself.
#[cfg(feature = "language")]
mod encoder {
    use lads_compiler::Bundle;
    pub use lads_language::Encoder;
    use lads_language::default_folder;

    use crate::arguments::Arguments;

    pub fn open(arguments: &Arguments, bundle: &Bundle) -> Result<Encoder, String> {
        let contract = bundle.contract();
        let named = arguments.language.encoder.clone();
        let folder = named.map_or_else(|| default_folder(&contract.language.encoder), Ok);
        let encoder = folder.and_then(|folder| Encoder::open(&folder, contract));
        encoder.map_err(|error| error.to_string())
    }

    pub fn words(encoder: &Encoder, text: &str) -> Result<Vec<f32>, String> {
        encoder.words(text).map_err(|error| error.to_string())
    }
}

/// This program was built without it.
#[cfg(not(feature = "language"))]
mod encoder {
    use lads_compiler::Bundle;

    use crate::arguments::Arguments;

    pub enum Encoder {}

    pub fn open(_: &Arguments, _: &Bundle) -> Result<Encoder, String> {
        Err("this lads-run was built without the language encoder; run \"make say\", or build it with \"cargo build --release -p lads-sim --features language\"".to_owned())
    }

    pub fn words(encoder: &Encoder, _: &str) -> Result<Vec<f32>, String> {
        match *encoder {}
    }
}
