"""Errors for the user: one or two lines (a line for each of several mistakes), an exit code, and with --json an object as the last line."""

import os
import sys
import traceback
from typing import Any

import click

from pipeline.errors import BadInput, PipelineError
from pipeline.failures import is_bad_input, is_disk_full, is_of_the_path
from pipeline.text import printable
from workflows.cli.output import write_json

INTERNAL = 1  # a defect of this program; the documented codes are those of the errors in pipeline/errors.py
LONGEST = 4000  # characters of an error; a path may have 4096


class Reported(Exception):
    """An error together with facts for the JSON object that ends the output."""

    def __init__(self, error: BaseException, facts: dict[str, Any]) -> None:
        super().__init__(str(error))
        self.error = error
        self.facts = facts


def judged(error: BaseException) -> tuple[int, str]:
    """The exit code, and the error in one or two lines."""
    if isinstance(error, PipelineError):
        return int(error.exit_code), str(error)
    if isinstance(error, click.exceptions.Exit):
        return error.exit_code, ""
    if isinstance(error, (KeyboardInterrupt, click.Abort)):
        return 130, "interrupted"
    if isinstance(error, click.ClickException):
        text = error.format_message()
        # click says where help is to be found in lines of its own; one will do.
        context = getattr(error, "ctx", None)
        return 2, f"{text if text.endswith(('.', '?')) else f'{text}.'} Try '{context.command_path} --help'." if context is not None else text
    if isinstance(error, OSError):
        return 2 if is_of_the_path(error) else 3, _of_the_system(error)
    if isinstance(error, MemoryError):
        return 3, "out of memory. Close other programs, or ask for less: smaller images, fewer voxels."
    if isinstance(error, UnicodeEncodeError):
        return 2, f"{error.object[:200]}: a file of this name cannot be opened in the encoding {error.encoding}. Set LC_ALL=C.UTF-8."
    text = " ".join(str(error).split())
    return INTERNAL, f"internal error: {type(error).__name__}: {text[:300]}. Run it again with --debug for the traceback."


def _of_the_system(error: OSError) -> str:
    if isinstance(error, FileNotFoundError) and not error.filename:
        try:
            os.getcwd()
        except FileNotFoundError:
            return "the working folder is gone: it was deleted or moved, and relative paths lead nowhere. Change to another folder, or give absolute paths."
    what = error.strerror or type(error).__name__
    if is_disk_full(error):
        return f"{error.filename or 'the disk'}: {what}. Free some space and run the same command again; nothing is lost."
    return f"{error.filename}: {what}." if error.filename else f"{what}."


def _shortened(text: str) -> str:
    """Without the middle of what is too long: the end says what to do."""
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]}…{text[-LONGEST // 2 :]}"


def report_failure(error: BaseException, *, as_json: bool, debug: bool) -> int:
    """Print the error and return the exit code."""
    facts: dict[str, Any] = {}
    if isinstance(error, Reported):
        facts, error = error.facts, error.error
    if is_bad_input(error):
        error = BadInput(str(error)).with_traceback(error.__traceback__)
    if isinstance(error, click.Abort) and isinstance(error.__cause__, EOFError):
        error = error.__cause__  # click takes the end of any file for that of the terminal; only a prompt's is an interrupt, and there are none
    if isinstance(error, SystemExit):
        raise error
    code, text = judged(error)
    if code == 0:
        return 0
    if debug:
        traceback.print_exception(error, file=sys.stderr)
    text = _shortened(printable(text))
    details = [_shortened(printable(line)) for line in getattr(error, "details", ())]
    print("\n  ".join([f"enerf: {text}", *details]), file=sys.stderr, flush=True)
    if as_json:
        facts |= {"details": details} if details else {}
        write_json({"event": "summary", "ok": False, "error": text, "kind": type(error).__name__, **facts, "exit_code": code})
    return code
