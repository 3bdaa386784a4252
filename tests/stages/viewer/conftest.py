"""One browser for all tests of a module."""

from collections.abc import Iterator
from typing import Any

import pytest

from tests.stages.viewer import browser


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser.chromium() as found:
        yield found
