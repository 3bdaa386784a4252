"""What all tests of training share."""

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module", autouse=True)
def no_curve() -> Iterator[None]:
    """Drawing the curve takes longer than such a little training."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stages.train.log.curve", lambda path, *_, **__: path.write_bytes(b""))
        yield
