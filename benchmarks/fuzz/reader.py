"""What a reader is, what it may do with an input, and how its outcome is judged.

An input is accepted, or refused by a documented exception; the command line answers it with a documented exit code and a line or two of plain text.
Anything else is a finding: another exception, a message that is too long or cannot be written, an input that takes longer than LIMIT, memory beyond
what is allowed, a process that dies.
"""

import contextlib
import io
import json
import os
import re
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from benchmarks.project import PACKAGES, ROOT

LIMIT = 5.0  # seconds of processor time for an input
WAITING = 60.0  # seconds for one that waits, as for a pipe that nobody writes to; other programs may keep the machine busy for some
LONGEST = 1500  # characters of a message
CODES = {0, 2, 3, 4, 5, 6}  # that a file may lead to; 130 and 143 are signals'
OURS = tuple(str(ROOT / package) + os.sep for package in PACKAGES)

Read = Callable[[bytes], None]


@dataclass(frozen=True)
class Opened:
    """A reader at work in a folder.

    read      reads an input; what it raises is its answer. Raises AssertionError where what was read is not sound
    commands  the command lines that read the input that was written last, and what has to be cleared before each
    """

    read: Read
    commands: tuple[tuple[str, ...], ...] = ()
    prepare: Callable[[bytes], None] = lambda data: None


@dataclass(frozen=True)
class Reader:
    """One kind of file.

    what      what is read, for people
    seeds     valid files
    changed   a mutation of one
    open      prepares a folder
    refusals  names of the exceptions by which it may refuse
    every     of so many inputs one goes through the command line too
    share     of the inputs that are asked for: files that one reader takes together share them
    """

    name: str
    what: str
    seeds: Callable[[], list[bytes]]
    changed: Callable[[Random, bytes], bytes]
    open: Callable[[Path], Opened]
    refusals: tuple[str, ...] = ("PipelineError",)
    every: int = 50
    share: float = 1.0


def bytes_of(write: Callable[[Path], object], name: str = "file") -> bytes:
    """What a function writes to a new file."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


class Hang(BaseException):
    """An input took too long; no `except Exception` stops it."""


@dataclass
class Outcome:
    """kind: "accepted", "refused" or "finding"; by: the exception or the exit code; text: the message; place: the line of ours that raised"""

    kind: str
    by: str = ""
    text: str = ""
    place: str = ""
    trace: str = field(default="", repr=False)

    @property
    def key(self) -> tuple[str, str]:
        """What makes two findings the same."""
        return self.by, self.place


@contextlib.contextmanager
def time_limit() -> Iterator[None]:
    """Raise Hang after LIMIT seconds of processor time, or WAITING seconds."""

    def alarm(number: int, _: Any) -> None:
        raise Hang(f"more than {LIMIT:g} s of processor time" if number == signal.SIGPROF else f"more than {WAITING:g} s")

    limits = ((signal.SIGPROF, signal.ITIMER_PROF, LIMIT), (signal.SIGALRM, signal.ITIMER_REAL, WAITING))
    before = [signal.signal(number, alarm) for number, _, _ in limits]
    for _, timer, seconds in limits:
        signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        for (number, timer, _), handler in zip(limits, before, strict=True):
            signal.setitimer(timer, 0)
            signal.signal(number, handler)


def judged(read: Callable[[], None], refusals: tuple[str, ...], *, limited: bool = True) -> Outcome:
    """The outcome of reading an input; `limited` in time."""
    try:
        with time_limit() if limited else contextlib.nullcontext():
            read()
    except (Exception, Hang) as error:
        names = {each.__name__ for each in type(error).__mro__}
        if isinstance(error, Hang) or not names & set(refusals):
            return _finding(f"AssertionError: {error}" if type(error) is AssertionError else type(error).__name__, error)
        wrong = wrong_message(str(error), 1 if "PipelineError" not in names else getattr(error, "exit_code", 1))
        return _finding(f"{type(error).__name__}, {wrong}", error) if wrong else Outcome("refused", type(error).__name__, str(error))
    return Outcome("accepted")


def wrong_message(text: str, code: int) -> str:
    """What is wrong with the message of a refusal; empty: nothing."""
    if len(text) > LONGEST:
        return "a message that is too long"
    if code == 1 and not text:
        return "a refusal without a reason"
    return ""


def commanded(arguments: tuple[str, ...], *, limited: bool = True) -> Outcome:
    """The outcome of a command line: its exit code and what it prints; `limited` in time."""
    from workflows.cli.main import main

    out, err = io.StringIO(), io.StringIO()
    try:
        with time_limit() if limited else contextlib.nullcontext(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(list(arguments))
    except (Exception, SystemExit, Hang) as error:
        return _finding(f"{arguments[0]}: {type(error).__name__}", error)
    last = err.getvalue().strip().splitlines()[-1:] or [""]
    wrong = f"exit code {code}" if code not in CODES else wrong_output(out.getvalue(), err.getvalue(), code)
    if not wrong and "--json" in arguments and not is_json(out.getvalue()):
        wrong = "no JSON on stdout"
    if wrong:
        trace = _with_traceback(arguments) if code == 1 and "--debug" not in arguments else out.getvalue()[-500:]
        places = re.findall(r'File "(.*)", line \d+, in (\w+)', trace)
        ours = [f"{os.path.relpath(path, ROOT)}:{function}" for path, function in places if path.startswith(OURS)]
        return Outcome("finding", f"{arguments[0]}: {wrong}", err.getvalue()[-LONGEST:], ours[-1] if ours else "", trace)
    return Outcome("refused" if code else "accepted", f"exit code {code}", last[0])


def _with_traceback(arguments: tuple[str, ...]) -> str:
    from workflows.cli.main import main

    err = io.StringIO()
    with contextlib.suppress(Exception, SystemExit), time_limit(), contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        main([*arguments, "--debug"])
    return err.getvalue()[-4000:]


def is_json(text: str) -> bool:
    """Whether a text is one JSON value, or one on each line."""
    for values in ([text], text.splitlines()):
        with contextlib.suppress(ValueError):
            return bool([json.loads(value, parse_constant=_no_json) for value in values])
    return False


def _no_json(name: str) -> None:
    raise ValueError(f"{name} is no JSON")


def wrong_output(out: str, err: str, code: int) -> str:
    """What is wrong with the output of a command; empty: nothing."""
    for name, text in (("stdout", out), ("stderr", err)):
        odd = next((character for character in text if character != "\n" and not character.isprintable()), None)
        if odd is not None:
            return f"{'half a surrogate pair' if 0xD800 <= ord(odd) < 0xE000 else 'a character that is not printable'} in {name}"
    if code and not err.strip():
        return f"exit code {code} without a word"
    lines = [line for line in err.splitlines() if "warning:" not in line]
    if code and "enerf:" in err and len(err[err.rindex("enerf:") :].splitlines()) > 2:
        return "an error of more than two lines"
    if any(len(line) > LONGEST for line in lines):
        return "a line that is too long"
    return ""


def _finding(by: str, error: BaseException) -> Outcome:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if frame.filename.startswith(OURS)] or frames[-1:]
    place = f"{os.path.relpath(ours[-1].filename, ROOT)}:{ours[-1].name}" if ours else ""
    return Outcome("finding", by, f"{type(error).__name__}: {error}"[:LONGEST], place, "".join(traceback.format_exception(error))[-4000:])


def address_space(extra: int) -> None:
    """Limit this process to so many bytes more than it has now."""
    import resource

    statm = Path("/proc/self/statm")
    if statm.exists():
        limit = int(statm.read_text().split()[0]) * resource.getpagesize() + extra
        resource.setrlimit(resource.RLIMIT_AS, (limit, resource.getrlimit(resource.RLIMIT_AS)[1]))


def quiet() -> None:
    """No warnings of libraries on damaged files."""
    import warnings

    warnings.simplefilter("ignore")
    sys.setrecursionlimit(1000)
