from __future__ import annotations

import signal

import pytest

from pipeline import errors


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
