//! Runs all contenders in turns, block by block: A B C, then C B A, and so on, so that slow changes
//! affect all alike.

use crate::contender::{Block, Contender};
use crate::error::BenchError;
use crate::stats::Rounds;

/// Measures rounds of blocks for every contender that offers them. `progress` gets the number of
/// finished rounds.
pub fn take_turns(
    contenders: &mut [&mut dyn Contender],
    rounds: &[Vec<Block>],
    progress: &mut dyn FnMut(usize),
) -> Result<Vec<Rounds>, BenchError> {
    let mut measured = vec![Rounds(vec![vec![]; rounds.len()]); contenders.len()];
    for (round, blocks) in rounds.iter().enumerate() {
        for block in blocks {
            let mut order: Vec<_> = (0..contenders.len()).collect();
            if round % 2 == 1 {
                order.reverse();
            }
            for turn in order {
                if contenders[turn].offers(block.work) {
                    contenders[turn].block(block, &mut measured[turn].0[round])?;
                }
            }
        }
        progress(round + 1);
    }
    Ok(measured)
}
