//! `lads self-test`: replays the policy's golden episode on this machine and compares the indices in force and the actions.

use lads_core::{Controller, Policy};
use lads_host::Memory;

use crate::model::Model;
use crate::refusal::Refusal;

/// Replays the golden episode and describes the result in one line; a policy without one is
/// refused.
pub fn self_test(model: &Model) -> Result<String, Refusal> {
    let policy = model.policy();
    let mut memory = Memory::of(&policy).map_err(|error| model.refused(error))?;
    let mut controller = memory
        .controller(&policy)
        .map_err(|error| model.refused(error))?;
    match replay(model, &policy, &mut controller)? {
        Some(line) => Ok(line),
        None => Err(Refusal::new(
            model.path.display(),
            "it carries no golden episode, so nothing can be tested",
            "export the bundle with one",
        )),
    }
}

/// Replays the golden episode, if there is one, and leaves the controller reset.
pub fn replay(
    model: &Model,
    policy: &Policy<'_>,
    controller: &mut Controller<'_, '_>,
) -> Result<Option<String>, Refusal> {
    let Some(golden) = policy.golden() else {
        return Ok(None);
    };
    let test = controller.self_test().map_err(|error| {
        Refusal::new(
            model.path.display(),
            format_args!("the self-test failed: {error}"),
            "do not run it on this machine; export and compile it again",
        )
    })?;
    Ok(Some(format!(
        "self-test passed: {} steps, {}largest difference of an action {:.1e} (tolerance {:.0e}), digest {:08x}",
        test.steps,
        if policy.index_count() > 0 {
            "all indices equal, "
        } else {
            ""
        },
        test.largest_error,
        golden.tolerance(),
        test.digest
    )))
}
