//! Runs a policy, hot, for `python/images.py` and `python/families.py`, which let it take turns with ONNX Runtime.
//!
//! usage: steps BUNDLE.onnx [FORMAT...], formats of weights, of which 32-bit floats are the first in any case.
//!
//! Prints a line for each instruction set that this CPU offers and each format. Then each line of its input, one of these and a number, is
//! that many control steps of the golden episode, which begins anew after its last, answered by a line of their nanoseconds, in which the thread ran. A format with which the golden episode is not
//! replayed is measured too, and said on stderr. What can fail ends with one line on stderr and exit code 2.
#![forbid(unsafe_code)]

use std::error::Error;
use std::io::{BufRead, Write};
use std::path::Path;
use std::process::ExitCode;

use lads_compiler::{Bundle, Options, Storage, WeightFormat, compile_with, named};
use lads_core::{Instruction, Isa, Policy};
use lads_host::Memory;
use rustix::time::{ClockId, clock_gettime};

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}

fn run() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let bundle = Bundle::open(Path::new(&args.next().ok_or("name a bundle (.onnx)")?))?;
    let mut images = vec![];
    for name in std::iter::once("f32".to_owned()).chain(args) {
        let weights = named(&name, WeightFormat::ALL, WeightFormat::name)?;
        let options = Options {
            storage: Some(Storage::of_weights(weights)),
            force: true,
            ..Options::default()
        };
        images.push((name, compile_with(&bundle, &options)?));
    }
    let mut policies = vec![];
    for (name, image) in &images {
        policies.push((name, Policy::new_checked(image.as_bytes())?));
    }
    let contenders: Vec<_> = (policies.iter())
        .flat_map(|policy| Isa::all().map(move |isa| (policy, isa)))
        .collect();
    let mut memories = contenders
        .iter()
        .map(|((_, policy), _)| Memory::of(policy))
        .collect::<Result<Vec<_>, _>>()?;
    let mut controllers = vec![];
    for (memory, ((format, policy), isa)) in memories.iter_mut().zip(&contenders) {
        let name = if *format == "f32" {
            isa.name().to_owned()
        } else {
            format!("{} {format}", isa.name())
        };
        let mut controller = memory.controller_with(policy, *isa)?;
        if let Err(error) = controller.self_test() {
            eprintln!("{name}: {error}");
        }
        controllers.push((name, policy, controller));
    }
    let mut out = std::io::stdout().lock();
    for (name, ..) in &controllers {
        writeln!(out, "{name}")?;
    }
    writeln!(out)?;
    out.flush()?;
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let (name, count) = line.rsplit_once(' ').ok_or("a contender and a number")?;
        let found = controllers.iter_mut().find(|(known, ..)| known == name);
        let (_, policy, controller) = found.ok_or("a contender that is not there")?;
        let golden = policy.golden().ok_or("the bundle has no golden episode")?;
        if let Some(id) = golden.instruction() {
            controller.set_instruction(Instruction::Id(id))?;
        }
        let mut action = vec![0.0; policy.contract().action_len()];
        let mut took = vec![];
        for i in 0..count.parse()? {
            if i % golden.len() == 0 {
                controller.reset();
            }
            let step = golden.step(i % golden.len()).ok_or("no step")?;
            let start = ran_ns();
            controller.step_with(step.observations(), &mut action)?;
            took.push((ran_ns() - start).to_string());
        }
        writeln!(out, "{}", took.join(" "))?;
        out.flush()?;
    }
    Ok(())
}

/// Returns for how many nanoseconds this thread has run, without the time in which it waited for others.
fn ran_ns() -> i64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    1_000_000_000 * time.tv_sec + time.tv_nsec
}
