//! Measures the time of a control step from Rust, hot: one step after another on the golden
//! episode's first observation.
//!
//! `cargo run --release -p lads-host --example step_cost -- MODEL STEPS` prints nanoseconds per
//! step; benches/python.py compares it with Python.

use std::process::ExitCode;
use std::time::Instant;

use lads_core::{Data, Instruction};

fn main() -> ExitCode {
    match measure() {
        Ok(nanoseconds) => {
            println!("{nanoseconds:.1}");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}

fn measure() -> Result<f64, Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let (model, steps) = match (arguments.next(), arguments.next()) {
        (Some(model), Some(steps)) => {
            let number = steps.parse::<u32>();
            let number = number.map_err(|_| format!("{steps} is no number of steps"))?;
            (model, number)
        }
        _ => return Err("give a policy and a number of steps".into()),
    };
    let mut loaded = lads_host::open(model.as_ref())?.load()?;
    let mut controller = loaded.controller();
    let policy = *controller.policy();
    let golden = policy.golden().ok_or("the policy has no golden episode")?;
    let first = golden.step(0).ok_or("its golden episode is empty")?;
    let mut action = vec![0.0; policy.contract().action_len()];
    if let Some(instruction) = golden.instruction() {
        controller.set_instruction(Instruction::Id(instruction))?;
    }
    let mut best = f64::INFINITY;
    // The fastest of ten shares, as benches/python.py measures.
    for _ in 0..10 {
        let start = Instant::now();
        for _ in 0..steps {
            match first.observations() {
                [(_, Data::F32(values))] => controller.step(values, &mut action)?,
                all => controller.step_with(all, &mut action)?,
            };
        }
        best = best.min(start.elapsed().as_nanos() as f64 / f64::from(steps));
    }
    Ok(best)
}
