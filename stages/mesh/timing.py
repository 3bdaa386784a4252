"""How long the parts of meshing take."""

import time
from collections.abc import Callable

Progress = Callable[[int, int, str], None]
SURFACE, DECIMATION, COLOURS = "surface", "cleaning and decimation", "colours at vertices"
NAMES = {"marching cubes": SURFACE, "colours": COLOURS, "texture": "photographs"}  # of what progress reports


class Stopwatch:
    """Seconds of each part: time passes for the part that is reported next. What comes between the last block of marching cubes and the first colours is
    the cleaning and decimation of the surface, which reports nothing."""

    def __init__(self) -> None:
        self._at = time.monotonic()
        self._last = ""
        self._spent: dict[str, float] = {}

    def lap(self, part: str) -> None:
        """Count the time since the last lap for this part."""
        now = time.monotonic()
        self._spent[part] = self._spent.get(part, 0.0) + now - self._at
        self._at, self._last = now, part

    def listening(self, progress: Progress) -> Progress:
        """The same progress, with a lap at each report."""

        def reported(done: int, total: int, text: str) -> None:
            part = NAMES.get(text, text)
            self.lap(DECIMATION if (self._last, part) == (SURFACE, COLOURS) else part)
            self._last = part
            progress(done, total, text)

        return reported

    @property
    def seconds(self) -> dict[str, float]:
        return {part: round(spent, 2) for part, spent in self._spent.items()}
