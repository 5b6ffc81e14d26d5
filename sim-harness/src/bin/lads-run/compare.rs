//! The `report` subcommand: one page that compares bundles, results and tables of one environment.
//!
//! Every input is opened and checked before the first episode, and all that are refused are named at once.

#[cfg(feature = "report")]
pub use with::run;
#[cfg(not(feature = "report"))]
pub use without::run;

#[cfg(feature = "report")]
mod with {
    use std::collections::BTreeMap;
    use std::ffi::OsStr;
    use std::path::Path;
    use std::process::ExitCode;
    use std::sync::atomic::AtomicBool;

    use lads_sim::output;
    use lads_sim::report::inputs::{self, Found};
    use lads_sim::report::{Behaviour, Comparison, Split, System};
    use lads_sim::results::Results;
    use lads_sim::rollout::Pictures;

    use crate::arguments::{Compared, LanguageArguments, PolicyArguments, Wanted};
    use crate::bench::{self, Bench};
    use crate::end::{End, print, refused, unwritable};
    use crate::{report, some_episodes, threads};

    /// An input that was opened and checked.
    enum Input {
        /// A bundle, which is yet to run, and the id of its environment.
        Bundle(PolicyArguments, String),
        /// A file of numbers.
        Numbers(Found),
    }

    impl Input {
        /// Ids of the environments that the input has something of.
        fn environments(&self) -> Vec<&str> {
            match self {
                Self::Bundle(_, id) => vec![id],
                Self::Numbers(found) => found.keys().map(String::as_str).collect(),
            }
        }
    }

    /// Compares the inputs on one page.
    pub fn run(asked: &Compared, stop: &AtomicBool) -> Result<ExitCode, End> {
        some_episodes(Some(asked.episodes.episodes))?;
        let threads = threads(asked.episodes.threads, false)?;
        let given: Vec<_> = asked.inputs.iter().map(|it| ("", it.as_path())).collect();
        output::check(&given, &[("-o", &asked.output)]).map_err(refused)?;

        let (mut opened, mut wrong) = (Vec::new(), Vec::new());
        for (place, path) in asked.inputs.iter().enumerate() {
            if asked
                .inputs
                .iter()
                .take(place)
                .any(|before| same(before, path))
            {
                wrong.push(about(path, "it is given twice; name each input once"));
                continue;
            }
            match open(path, asked, threads, stop) {
                Ok(input) => opened.push((path.as_path(), input)),
                Err(End::Refused(line)) => wrong.push(about(path, &line)),
                Err(end) => return Err(end),
            }
        }
        if !wrong.is_empty() {
            return Err(End::AllRefused(wrong));
        }
        let environment = environment(&opened)?;
        let mut systems = Vec::new();
        for (path, input) in opened {
            match input {
                Input::Bundle(policy, _) => {
                    let wanted = wanted(asked, &policy, threads);
                    systems.push(bench::with(&wanted, stop, |bench| played(bench, path))?);
                }
                Input::Numbers(mut found) => {
                    systems.extend(found.remove(&environment).unwrap_or_default());
                }
            }
        }
        tell_apart(&mut systems);
        let comparison = Comparison {
            environment: &environment,
            systems,
        };
        let page = comparison.html();
        let page = page.map_err(|error| unwritable("-o", &asked.output, &error))?;
        output::write(&asked.output, page.as_bytes())
            .map_err(|error| unwritable("-o", &asked.output, &error))?;
        let (count, path) = (comparison.systems.len(), asked.output.display());
        let systems = if count == 1 { "system" } else { "systems" };
        let line = format!("{environment}: {count} {systems} compared in {path}\n");
        print(&line)?;
        Ok(ExitCode::SUCCESS)
    }

    /// Whether two paths lead to one file.
    fn same(a: &Path, b: &Path) -> bool {
        let [a, b] = [a, b].map(|path| path.canonicalize().ok());
        a.is_some() && a == b
    }

    /// Puts the input's name before what is wrong with it, unless it begins with it.
    fn about(path: &Path, wrong: &str) -> String {
        let path = path.display().to_string();
        if wrong.starts_with(&path) {
            return wrong.to_owned();
        }
        format!("{path}: {wrong}")
    }

    /// Opens an input: numbers if its name ends in .json, else a bundle, with everything that its episodes need.
    fn open(
        path: &Path,
        asked: &Compared,
        threads: usize,
        stop: &AtomicBool,
    ) -> Result<Input, End> {
        if path
            .extension()
            .is_some_and(|it| it.eq_ignore_ascii_case("json"))
        {
            let found = inputs::read(path, asked.table.as_deref());
            return found.map(Input::Numbers).map_err(refused);
        }
        let policy = PolicyArguments {
            model: path.to_owned(),
            image: None,
            isa: asked.isa,
            exact: false,
        };
        let id = bench::with(&wanted(asked, &policy, threads), stop, |bench| {
            Ok(bench.environment.id().to_owned())
        })?;
        Ok(Input::Bundle(policy, id))
    }

    /// The episodes of a bundle, with what the figures need of them.
    fn wanted<'a>(asked: &'a Compared, policy: &'a PolicyArguments, threads: usize) -> Wanted<'a> {
        const PLAIN: &LanguageArguments = &LanguageArguments {
            sub_tasks: None,
            sentence_anyway: false,
            encode_language: false,
            encoder: None,
        };
        Wanted {
            traced: u32::MAX,
            pictures: Pictures::Decisions,
            of_table: Some("report"),
            ..Wanted::of(policy, PLAIN, &asked.episodes, threads)
        }
    }

    /// Finds the one environment that all inputs have something of.
    fn environment(opened: &[(&Path, Input)]) -> Result<String, End> {
        let mut by_id: BTreeMap<&str, Vec<String>> = BTreeMap::new();
        for (path, input) in opened {
            for id in input.environments() {
                let files = by_id.entry(id).or_default();
                files.push(path.display().to_string());
            }
        }
        let common: Vec<_> = by_id
            .iter()
            .filter(|(_, files)| files.len() == opened.len())
            .map(|(id, _)| *id)
            .collect();
        if let [only] = common[..] {
            return Ok(only.to_owned());
        }
        let each = by_id.iter();
        let each = each.map(|(id, files)| format!("{id} ({})", files.join(", ")));
        let each = each.collect::<Vec<_>>().join("; ");
        Err(refused(if common.is_empty() {
            format!("the inputs are of several environments: {each}; compare those of one")
        } else {
            format!("the tables are of several environments: {each}; name one with --table")
        }))
    }

    /// Runs the episodes of a bundle.
    fn played(bench: &Bench<'_>, path: &Path) -> Result<System, End> {
        let name = inputs::short(&path.display().to_string(), ".onnx");
        let (results, evaluated) = bench.run(bench.evaluation.setup, &name)?;
        let (evaluation, traces) = (&bench.evaluation, &evaluated.traces);
        let drawn = report::drawn(evaluation, traces)?;
        Ok(System {
            name,
            file: path.display().to_string(),
            group: None,
            facts: inputs::facts(
                &results.bundle_sha256,
                (&results.noise, results.seed),
                &results.decision.rule,
                results.episodes_per_instruction,
            ),
            policies: 1,
            sweep: BTreeMap::new(),
            splits: splits(&results),
            behaviour: Behaviour::of(evaluation.contract, traces, &drawn, &results),
        })
    }

    fn splits(results: &Results) -> Vec<Split> {
        let commanded = |name: &str| {
            let own = results.instructions.iter().filter(|it| it.split == name);
            own.map(|it| it.completions.len()).max()
        };
        let splits = results.splits.0.iter();
        splits
            .map(|(name, result)| Split {
                name: name.clone(),
                score: result.score.clone(),
                commanded: commanded(name),
            })
            .collect()
    }

    /// Names inputs whose short names are equal by their files' names, and where these are equal by their paths.
    fn tell_apart(systems: &mut [System]) {
        let longer: [fn(&Path) -> &OsStr; 2] =
            [|file| file.file_name().unwrap_or_default(), Path::as_os_str];
        for name in longer {
            let mut counts: BTreeMap<String, usize> = BTreeMap::new();
            for system in systems.iter().filter(|system| system.group.is_none()) {
                *counts.entry(system.name.clone()).or_default() += 1;
            }
            for system in systems.iter_mut().filter(|system| system.group.is_none()) {
                if counts.get(&system.name).is_some_and(|&count| count > 1) {
                    system.name = name(Path::new(&system.file)).to_string_lossy().into_owned();
                }
            }
        }
    }
}

/// Stand-in for builds without reports.
#[cfg(not(feature = "report"))]
mod without {
    use std::process::ExitCode;
    use std::sync::atomic::AtomicBool;

    use crate::arguments::Compared;
    use crate::end::End;
    use crate::report;

    /// Refuses `report`, which this build does not have.
    pub fn run(asked: &Compared, _: &AtomicBool) -> Result<ExitCode, End> {
        report::check(Some(&asked.output)).map(|()| ExitCode::SUCCESS)
    }
}
