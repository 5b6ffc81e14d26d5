//! Runs a policy that sees images, hot, for `python/images.py`, which lets it take turns with ONNX Runtime.
//!
//! Prints a line for each instruction set that this CPU offers. Then each line of its input, an instruction set and a number, is that many
//! control steps of the golden episode, answered by a line of their nanoseconds. What can fail ends with one line on stderr and exit code 2.
#![forbid(unsafe_code)]

use std::error::Error;
use std::io::{BufRead, Write};
use std::path::Path;
use std::process::ExitCode;
use std::time::Instant;

use lads_compiler::{Bundle, compile};
use lads_core::{Isa, Policy};
use lads_host::Memory;

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
    let path = std::env::args().nth(1).ok_or("name a bundle (.onnx)")?;
    let image = compile(&Bundle::open(Path::new(&path))?)?;
    let policy = Policy::new_checked(image.as_bytes())?;
    let golden = policy.golden().ok_or("the bundle has no golden episode")?;
    let isas: Vec<Isa> = Isa::all().collect();
    let mut memories = isas
        .iter()
        .map(|_| Memory::of(&policy))
        .collect::<Result<Vec<_>, _>>()?;
    let mut controllers = vec![];
    for (memory, &isa) in memories.iter_mut().zip(&isas) {
        let mut controller = memory.controller_with(&policy, isa)?;
        controller.self_test()?;
        controller.reset();
        controllers.push(controller);
    }
    let mut out = std::io::stdout().lock();
    for isa in &isas {
        writeln!(out, "{}", isa.name())?;
    }
    writeln!(out)?;
    out.flush()?;
    let mut action = vec![0.0; policy.contract().action_len()];
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let (name, count) = line
            .split_once(' ')
            .ok_or("an instruction set and a number")?;
        let at = isas.iter().position(|isa| isa.name() == name);
        let controller = controllers
            .get_mut(at.ok_or("an instruction set that is not there")?)
            .ok_or("no controller")?;
        let mut took = vec![];
        for i in 0..count.parse()? {
            let step = golden.step(i % golden.len()).ok_or("no step")?;
            let start = Instant::now();
            controller.step_with(step.observations(), &mut action)?;
            took.push(start.elapsed().as_nanos().to_string());
        }
        writeln!(out, "{}", took.join(" "))?;
        out.flush()?;
    }
    Ok(())
}
