"""A fleet without workers: how long it waits, and the messages about it."""

LONGEST = 300.0  # seconds that a fleet waits while it has no worker; for jobs of a queue as long as it takes
REPORT_SECONDS = 30.0  # seconds before that is reported


class Absence:
    """queued: whether workers are jobs of a queue, which may be hours in coming."""

    def __init__(self, *, queued: bool) -> None:
        self.queued = queued
        self._since: float | None = None

    def note(self, *, anyone: bool, now: float) -> str | None:
        """The message that is due, if any. now: seconds, of any clock."""
        self._since = None if anyone else now if self._since is None else self._since
        if self._since is None or now - self._since < REPORT_SECONDS:
            return None
        return f"no worker is there; one is waited for, {'as long as it takes' if self.queued else f'{LONGEST / 60:.0f} minutes'}"

    def ends(self, now: float) -> str | None:
        """Why the fleet is to end, a sentence; None where it goes on."""
        if self.queued or self._since is None or now - self._since <= LONGEST:
            return None
        return f"no worker was there for {LONGEST / 60:.0f} minutes."
