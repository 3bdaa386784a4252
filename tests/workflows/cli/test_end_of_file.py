"""A file that ends too early is not a terminal that was closed: exit code 130 is that of an interrupt alone."""

import pytest

from workflows.cli import files, main


def test_the_end_of_a_file_is_no_interrupt(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def ends(context: object) -> None:
        raise EOFError("Ran out of input")

    monkeypatch.setattr(files.inspect, "invoke", ends)
    assert main.main(["inspect", "."]) == 1
    assert "EOFError" in capsys.readouterr().err
