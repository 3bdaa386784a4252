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
    assert error.exit_code == code
    assert isinstance(error, errors.PipelineError)
    assert str(error) == "what went wrong"


def test_an_interruption_exits_as_a_shell_expects() -> None:
    assert errors.Interrupted().exit_code == 130
    assert errors.Interrupted(signal.SIGTERM).exit_code == 143
    assert "SIGTERM" in str(errors.Interrupted(signal.SIGTERM))


def test_every_error_stands_in_the_drawing() -> None:
    kinds = [name for name, value in vars(errors).items() if isinstance(value, type) and issubclass(value, errors.PipelineError)]
    assert all(name in (errors.__doc__ or "") for name in kinds)
