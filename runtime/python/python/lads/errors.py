"""What can go wrong: every exception of the package, under one root. Their texts name the thing, what is wrong with it, and the remedy."""


class LadsError(Exception):
    """Root of all exceptions of this package."""


class OpenError(LadsError, ValueError):
    """A file is no policy that can be used, or an option of compiling makes no sense."""


class CompileError(OpenError):
    """A bundle does not compile, or the image with fewer bits does not pass the gate."""


class ImportOnnxError(OpenError):
    """A policy cannot be imported: something is missing or contradicts."""

    def __init__(self, text: str, problems=()) -> None:
        super().__init__(text)
        self.problems: tuple[tuple[str, str], ...] = tuple(problems)
        """All that is to be settled: what each is about, and what is wrong with it."""


class WorkspaceError(LadsError, MemoryError):
    """There is no memory, or there are no threads, for a controller."""


class InputError(LadsError, ValueError):
    """An array is not what a channel takes: its type, dtype, shape, layout or values."""


class InstructionError(LadsError, ValueError):
    """An instruction is unknown, malformed or missing."""


class StepError(LadsError, RuntimeError):
    """A control step gave no action, such as one beyond the end of the context."""


class RecordError(LadsError, OSError):
    """A recording cannot be written, or the policy cannot be recorded."""


class SelfTestError(LadsError, RuntimeError):
    """The policy answers otherwise on this machine than recorded, or holds no golden episode."""


class ClosedError(LadsError, RuntimeError):
    """A controller is used after it was closed."""


class BusyError(LadsError, RuntimeError):
    """A controller is used by two threads at once."""


class ForkError(LadsError, RuntimeError):
    """A controller is used in another process than the one that made it."""


class EvaluationError(LadsError, RuntimeError):
    """An evaluation cannot go on: what an environment gives or takes does not fit, or an episode failed."""


class ProofError(LadsError, ValueError):
    """Rollouts or numbers that are to be judged contradict each other."""
