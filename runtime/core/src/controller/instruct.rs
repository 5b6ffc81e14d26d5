//! Setting the instruction of a controller.

use lads_image::ExecError;
use lads_image::records::Event;

use super::{Controller, Instruction};
use crate::contract::ChannelId;
use crate::errors::{InstructionError, RunError};
use crate::inputs::Data;
use crate::run::{Counters, Run};

impl Controller<'_, '_> {
    /// Sets the instruction to follow from the next step on and starts a new episode at `t = 0`.
    /// Sampling and noise continue where they were.
    ///
    /// A refused instruction changes nothing. [`InstructionError::Run`], which a sound image never causes, leaves the
    /// controller without an instruction.
    pub fn set_instruction(&mut self, instruction: Instruction) -> Result<(), InstructionError> {
        let contract = self.policy.contract();
        let channel = contract
            .instruction_channel()
            .ok_or(InstructionError::NotTaken)?
            .id();
        let words = match instruction {
            Instruction::Id(id) => {
                let count = contract.instruction_count() as u32;
                contract
                    .instruction(id as usize)
                    .ok_or(InstructionError::Unknown { id, count })?
                    .words
            }
            Instruction::Words(words) => words,
        };
        let count = contract.check_words(words)?;
        self.instructed = false;
        self.take_in(&[(channel, Data::F32(words))], count as u32)
            .map_err(InstructionError::Run)?;
        self.instructed = true;
        self.reset();
        Ok(())
    }

    /// Runs the calls of a new instruction; the KV caches and plain states that they fill are kept
    /// over resets.
    fn take_in(&mut self, given: &[(ChannelId, Data)], words: u32) -> Result<(), RunError> {
        if !self.workspace.fits(&self.policy) {
            return Err(RunError::Program(ExecError::Span));
        }
        self.workspace.now.plain.fill(0.0);
        self.workspace.next.plain.fill(0.0);
        let mut run = Run::new(&self.policy, &mut self.workspace, given, Counters::START);
        run.words = words;
        for call in run.tables.due(Event::Instruct, 0) {
            run.call(&call)?;
        }
        let counters = run.counters;
        for (base, rows) in self.base.iter_mut().zip(counters.rows) {
            *base = rows.len;
        }
        self.counters = counters;
        self.workspace.now.copy_from(&self.workspace.next);
        Ok(())
    }
}
