//! How Mesa draws where there is no GPU: on the thread that asks, not on threads of its own.
//!
//! With threads of its own, Mesa 22.3 ended an evaluation of 5,050 episodes by a segmentation fault, where it looks through the resources of a
//! picture (by the fault's address), which its threads free. It came once and could not be brought again; without such threads the same
//! evaluation ended well. Pictures are small here and episodes run on all cores, so nothing is lost: a picture takes no longer.

use std::os::unix::process::CommandExt;
use std::process::Command;

/// Number of threads that Mesa's software renderer draws on, which it reads when it is loaded.
const THREADS: &str = "LP_NUM_THREADS";

/// Starts the running program anew, in the same process, with a renderer that has no threads of its own; does nothing where the caller's
/// environment says how many it has. A program cannot change its own environment safely.
pub fn draw_on_own_thread() {
    if std::env::var_os(THREADS).is_some() {
        return;
    }
    let mut arguments = std::env::args_os();
    let (Some(name), Ok(program)) = (arguments.next(), std::env::current_exe()) else {
        return;
    };
    // What comes back is why it could not be done; then it is drawn with threads, as nearly always goes well.
    let _ = Command::new(program)
        .arg0(name)
        .args(arguments)
        .env(THREADS, "0")
        .exec();
}
