//! Real-time privileges of a control thread: SCHED_FIFO and locked memory. If the operating system
//! refuses them, the report says so.

use std::fmt;

use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// Real-time priority above ordinary threads, below the kernel's own real-time threads.
const PRIORITY: u8 = 50;

/// Privileges that this thread was granted; they end when the value is dropped.
#[derive(Debug)]
pub struct Realtime {
    fifo: Result<(), String>,
    locked: Option<Result<(), String>>,
}

impl Realtime {
    /// Asks for SCHED_FIFO and for memory that is not paged out.
    pub fn enter() -> Self {
        let flags = rustix::mm::MlockAllFlags::CURRENT | rustix::mm::MlockAllFlags::FUTURE;
        let locked = rustix::mm::mlockall(flags).map_err(|error| error.to_string());
        let mut granted = Self::scheduling();
        granted.locked = Some(locked);
        granted
    }

    /// Asks for SCHED_FIFO alone. Threads that are started meanwhile inherit it.
    pub fn scheduling() -> Self {
        let priority = PRIORITY
            .try_into()
            .map_or(ThreadPriority::Max, ThreadPriority::Crossplatform);
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        let fifo = set_thread_priority_and_policy(thread_native_id(), priority, policy)
            .map_err(|error| format!("{error:?}"));
        Self { fifo, locked: None }
    }

    /// Returns whether the thread runs before all ordinary ones.
    pub fn is_fifo(&self) -> bool {
        self.fifo.is_ok()
    }
}

impl Drop for Realtime {
    fn drop(&mut self) {
        if self.fifo.is_ok() {
            let normal =
                ThreadSchedulePolicy::Normal(thread_priority::NormalThreadSchedulePolicy::Other);
            // Failing to lower the priority again affects only this process.
            let _ = set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Min, normal);
        }
        if let Some(Ok(())) = self.locked {
            let _ = rustix::mm::munlockall();
        }
    }
}

impl fmt::Display for Realtime {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.fifo {
            Ok(()) => write!(f, "SCHED_FIFO {PRIORITY}")?,
            Err(error) => write!(f, "ordinary scheduling (SCHED_FIFO refused: {error})")?,
        }
        match &self.locked {
            Some(Ok(())) => f.write_str(", memory locked"),
            Some(Err(error)) => write!(f, ", memory not locked ({error})"),
            None => Ok(()),
        }
    }
}
