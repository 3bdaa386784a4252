"""Standard output and standard error while a command runs: a failed write ends nothing, but is reported.

The result of a command decides its exit code. Failed writes to standard error, or of the closing words of a command that makes files, are ignored. Where the
command's output proper (a listing, anything with --json) fails, a command that went well ends with UNWRITTEN. A reader that closes the pipe of a
plain listing (`| head`) has had enough, which is no failure.
"""

import contextlib
import errno
import json
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TextIO, cast

from pipeline.library_output import libraries_apart
from pipeline.text import printable

UNWRITTEN = 3  # exit code: the requested output could not be written
DEEPEST = 64  # levels of a value in JSON; a document that nests deeper was made to
_LARGEST = 2**64  # readers of JSON know no larger integers


class Stream:
    """A text stream that keeps its first failure instead of raising it.

    It shows no `buffer`: click and others would write past it.
    """

    def __init__(self, stream: TextIO | None, *, missed: bool) -> None:
        self.stream = stream
        self.missed = missed
        self.failure: OSError | None = None  # the error of a write that was missed, or None

    def write(self, text: str) -> int:
        if not isinstance(text, str):
            raise TypeError(f"expected text, found {type(text).__name__}")
        if self.stream is None:
            self._failed(OSError(errno.EBADF, os.strerror(errno.EBADF)))
            return len(text)
        try:
            self.stream.write(text)
        except UnicodeEncodeError:
            name = self.stream.encoding or "ascii"
            return self.write(text.encode(name, "backslashreplace").decode(name))
        except (OSError, ValueError) as error:
            self._failed(error)
        return len(text)

    def flush(self) -> None:
        try:
            if self.stream is not None:
                self.stream.flush()
        except (OSError, ValueError) as error:
            self._failed(error)

    def isatty(self) -> bool:
        return self.stream is not None and not self.stream.closed and self.stream.isatty()

    def writable(self) -> bool:
        return True

    @property
    def encoding(self) -> str:
        return (self.stream.encoding if self.stream is not None else None) or "utf-8"

    @property
    def errors(self) -> str:
        return "backslashreplace"

    @property
    def closed(self) -> bool:
        return False

    def fileno(self) -> int:
        if self.stream is None:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        return self.stream.fileno()

    @contextmanager
    def unimportant(self) -> Iterator[None]:
        """While open, nothing that cannot be written is missed."""
        former, self.missed = self.missed, False
        try:
            yield
        finally:
            self.missed = former

    def _failed(self, error: OSError | ValueError) -> None:
        if self.missed and self.failure is None:
            self.failure = error if isinstance(error, OSError) else OSError(errno.EBADF, os.strerror(errno.EBADF))

    def settle(self) -> None:
        """Empty the buffer: Python flushes it at exit, and a failure there would give exit code 120."""
        self.flush()
        if self.stream is None:
            return
        try:
            self.stream.flush()
        except ValueError:
            pass  # closed
        except OSError:
            with contextlib.suppress(OSError, ValueError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self.stream.fileno())
                os.close(nowhere)
                self.stream.flush()


@contextmanager
def watched(*, debug: bool = False) -> Iterator[Stream]:
    """While open, standard output and standard error are Streams, and what libraries say goes into a log (`pipeline.library_output`); yields the first."""
    _fill_descriptors()
    former = sys.stdout, sys.stderr
    with libraries_apart(show=debug) as terminal:
        out, err = Stream(sys.stdout, missed=True), Stream(terminal, missed=False)
        sys.stdout, sys.stderr = cast("TextIO", out), cast("TextIO", err)
        try:
            yield out
        finally:
            sys.stdout, sys.stderr = former
            out.settle()
            err.settle()


def _fill_descriptors() -> None:
    """A process that was started without descriptors 0 to 2 (`>&-`) would give their numbers to the files that it opens, and libraries that write to
    "standard error" would write into those."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free


def exit_code(out: Stream, code: int, *, as_json: bool) -> int:
    """The code of a command that ended with `code`, by what became of its output; says on standard error what could not be written."""
    out.flush()
    if code != 0 or out.failure is None or (out.failure.errno == errno.EPIPE and not as_json):
        return code
    why = out.failure.strerror or type(out.failure).__name__
    print(f"enerf: standard output: {why}. Not all of the output could be written; all else is done.", file=sys.stderr, flush=True)
    return UNWRITTEN


def listing(*lines: str) -> None:
    """Lines that a command is for, on standard output. Names of files in them may hold anything, also line ends."""
    print("\n".join(map(printable, lines)), flush=True)


def closing(*lines: str) -> None:
    """Print what a command did on standard output; lost where that fails."""
    stream = sys.stdout
    with stream.unimportant() if isinstance(stream, Stream) else contextlib.nullcontext():
        listing(*lines)


def conclude(*lines: str, as_json: bool, quiet: bool = False, code: int = 0, **facts: Any) -> int:
    """End a command: with --json by its summary, the last line; else by what it did, in words. Returns the exit code."""
    if as_json:
        write_json({"event": "summary", "ok": code == 0, **facts, "exit_code": code})
    elif not quiet:
        closing(*lines)
    return code


def write_json(value: Any, *, indent: int | None = None) -> None:
    """One JSON object on standard output, in ASCII: names keep every byte, as escapes."""
    print(json.dumps(plain(value), indent=indent, ensure_ascii=True, allow_nan=False), flush=True)


def plain(value: Any, depth: int = 0) -> Any:
    """`value` in types of JSON: paths and arrays become text and lists, numbers that are not finite null, integers beyond 64 bits text."""
    if depth > DEEPEST:
        return "nested too deeply"
    if isinstance(value, Mapping):
        return {_text(name): plain(item, depth + 1) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, depth + 1) for item in value]
    if value is None or isinstance(value, (str, bool)):
        return value
    if isinstance(value, int):
        return value if abs(value) < _LARGEST else _text(value)
    if hasattr(value, "tolist"):
        return plain(value.tolist(), depth + 1)
    if isinstance(value, float):
        return value if value - value == 0 else None
    return str(value)


def _text(value: Any) -> str:
    """Also of integers with more digits than Python writes out."""
    return hex(value) if isinstance(value, int) and abs(value) >= _LARGEST else str(value)
