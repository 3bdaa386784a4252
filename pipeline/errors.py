"""All errors that the engine raises on purpose. Each carries one or two lines for the user and the exit code of the process.

PipelineError
├── BadInput           2   the source, the run folder or a file given by the user cannot be used
├── UsageError         2   the request itself is wrong: a value of a wrong type, a stage that does not exist
│   ├── UnknownSetting 2   a setting that does not exist; names the nearest one
│   ├── Mistakes       2   several at once, in a file that was given
│   └── TooLittleMemory 2  a stage needs more memory than it may take
├── StageFailed        3   a stage raised; the original is its __cause__
│   └── DiskFull       3   ... because the disk, or the quota, is full
├── CorruptArtifact    4   what a run holds is not what was written
├── RunLocked          5   another process is writing this run
└── Interrupted        130 by Ctrl-C, 143 by SIGTERM
"""

import signal


class PipelineError(Exception):
    """Root of the tree; `exit_code` is what the command line exits with."""

    exit_code: int = 1


class BadInput(PipelineError):
    """What was handed in cannot be used: what, where, found, expected, remedy."""

    exit_code = 2


class UsageError(PipelineError):
    """The request makes no sense: a wrong type, a value out of range, an unknown stage."""

    exit_code = 2


class UnknownSetting(UsageError):
    """A setting that no stage has; the text names the nearest one."""


class Mistakes(UsageError):
    """All mistakes in what was given; the text says how many and names the first."""

    def __init__(self, text: str, details: tuple[str, ...]) -> None:
        super().__init__(text)
        self.details = details  # a line for each that is shown


class TooLittleMemory(UsageError):
    """A stage needs more memory than it may take; found out before its work."""

    def __init__(self, text: str, needed: int = 0) -> None:
        super().__init__(text)
        self.needed = needed  # bytes; 0 where it is not known


class StageFailed(PipelineError):
    """A stage raised. The text is one line; `__cause__` is the original, for a traceback."""

    exit_code = 3


class DiskFull(StageFailed):
    """No space (or quota) left while a stage wrote. What was published before stays."""


class CorruptArtifact(PipelineError):
    """Files of a run are not those that were written."""

    exit_code = 4

    def __init__(self, text: str, files: tuple[str, ...] = ()) -> None:
        super().__init__(text)
        self.files = files  # "stage/relative/path" of each that is known, else empty


class RunLocked(PipelineError):
    """Another process holds the run's lock; the text names it."""

    exit_code = 5


class Interrupted(PipelineError):
    """A signal asked to stop and a safe point was reached. Work so far is kept."""

    def __init__(self, number: int = signal.SIGINT, text: str | None = None) -> None:
        super().__init__(text or f"interrupted by {signal.Signals(number).name}")
        self.number = int(number)  # SIGINT or SIGTERM
        self.exit_code = 128 + self.number  # 128 + number: 130 or 143
