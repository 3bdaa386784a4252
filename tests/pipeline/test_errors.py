import signal
from pathlib import Path

import pytest

from pipeline import errors
from pipeline.failures import translated


@pytest.mark.parametrize(
    ("kind", "code"),
    [("BadInput", 2), ("UsageError", 2), ("UnknownSetting", 2), ("StageFailed", 3), ("DiskFull", 3), ("CorruptArtifact", 4), ("RunLocked", 5)],
)
def test_exit_codes(kind: str, code: int) -> None:
    error = getattr(errors, kind)("what went wrong")
    assert isinstance(error, errors.PipelineError)
    assert (error.exit_code, str(error)) == (code, "what went wrong")
    assert kind in (errors.__doc__ or ""), "every error stands in the drawing"


def test_an_interruption_exits_as_a_shell_expects() -> None:
    assert errors.Interrupted().exit_code == 130
    assert errors.Interrupted(signal.SIGTERM).exit_code == 143
    assert "SIGTERM" in str(errors.Interrupted(signal.SIGTERM))


def test_an_error_of_a_package_that_does_not_know_the_engine_is_bad_input() -> None:
    class OfTheMethod(ValueError):
        bad_input = True

    found = translated(OfTheMethod("asset: its orbit is odd"), "turntable", Path())
    assert isinstance(found, errors.BadInput)
    assert str(found) == "asset: its orbit is odd"
