"""All exceptions of the package, under one root. Their texts name the thing, the fault, and the remedy."""


class LadsError(Exception):
    """Root of all exceptions of this package."""


class OpenError(LadsError, ValueError):
    """A file cannot be used as a policy, or an option of compiling is invalid."""


class CompileError(OpenError):
    """A bundle does not compile, or the image with fewer bits does not pass the gate."""


class ImportOnnxError(OpenError):
    """A policy cannot be imported: fields are missing or contradictory."""

    def __init__(self, text: str, problems=()) -> None:
        super().__init__(text)
        self.problems: tuple[tuple[str, str], ...] = tuple(problems)
        """All problems, each with its subject and its fault."""


class WorkspaceError(LadsError, MemoryError):
    """Memory or threads for a controller are not available."""


class InputError(LadsError, ValueError):
    """An array does not fit a channel: by its type, dtype, shape, layout or values."""


class InstructionError(LadsError, ValueError):
    """An instruction is unknown, malformed or missing."""


class LanguageError(LadsError, ValueError):
    """The language encoder is missing, damaged or another one, or a sentence is empty or too long."""


class StepError(LadsError, RuntimeError):
    """A control step gave no action, such as one beyond the end of the context."""


class RecordError(LadsError, OSError):
    """A recording cannot be written, or the policy cannot be recorded."""


class SelfTestError(LadsError, RuntimeError):
    """The policy's answers on this machine differ from the recorded ones, or it holds no golden episode."""


class ClosedError(LadsError, RuntimeError):
    """A controller is used after it was closed."""


class BusyError(LadsError, RuntimeError):
    """A controller is used by two threads at once."""


class ForkError(LadsError, RuntimeError):
    """A controller is used in another process than the one that made it."""


class EvaluationError(LadsError, RuntimeError):
    """An evaluation cannot continue: the environment does not fit the policy, or an episode failed."""


class ProofError(LadsError, ValueError):
    """Rollouts or numbers to be judged contradict each other."""
