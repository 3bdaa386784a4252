"""What the command line of a fleet says for all scenes, and the options of a cluster."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline import files
from pipeline.errors import BadInput, UsageError
from pipeline.text import printable
from workflows.asset import Workflow
from workflows.cli.resolve import Settings, parse_toml
from workflows.fleet.checked import Text

_MOST_BYTES = 2**16


def settings_of(texts: Sequence[str], workflow: Workflow) -> dict[str, dict[str, Any]]:
    """The table of `--set stage.name=value` options; each value is still text, and checked. Raises UsageError."""
    checked = Settings({stage.name: stage.settings for stage in workflow.stages})
    found: dict[str, dict[str, Any]] = {}
    for text in texts:
        checked.put_option(text)
        path, _, value = text.partition("=")
        stage, _, name = path.strip().partition(".")
        found.setdefault(stage, {})[name] = Text(value.strip())
    return found


def read_cluster_options(path: Path) -> dict[str, Any]:
    """A TOML file with the options of a Dask cluster. Raises UsageError and BadInput."""
    try:
        with open(files.open_plain(path), "rb") as file:
            data = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise UsageError(f"--cluster-options {path}: cannot be read ({error.strerror}).") from None
    try:
        return parse_toml(data.decode("utf-8"), _MOST_BYTES)
    except ValueError as error:  # UnicodeDecodeError is one
        raise BadInput(f"--cluster-options {path}: not valid TOML: {printable(error, 300)}.") from None
