"""Command-line options for all scenes of a fleet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from workflows.cli.resolve import Settings
from workflows.fleet.checked import Text
from workflows.workflow import Workflow


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
