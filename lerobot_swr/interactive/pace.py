"""A steady beat: every step has its due time, and lateness is counted instead of pushed along."""

import time
from collections.abc import Callable

PATIENCE = 5  # beats behind after which the beat starts anew instead of being caught up with


class Pace:
    """Due times at a fixed distance, whatever the work between them takes.

    Args:
        rate_hz: Beats per second.
        clock: Seconds.
        sleep: Waits some seconds.

    Attributes:
        beats: How many there have been.
        late: Those whose work was done only after the next was due.
    """

    def __init__(
        self,
        rate_hz: float,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self._period, self._clock, self._sleep = 1 / rate_hz, clock, sleep
        self.beats = self.late = 0
        self._due: float | None = None
        self.speed = 1.0

    def wait(self) -> None:
        """Until the next beat is due; at once if it is overdue."""
        now, period = self._clock(), self._period / self.speed
        if self._due is None:
            self._due = now
        self._due += period
        self.beats += 1
        if now > self._due:
            self.late += 1
            if now > self._due + PATIENCE * period:
                self._due = now
            return
        self._sleep(self._due - now)

    def restart(self) -> None:
        """Forget the beat, after a time in which nobody kept it."""
        self._due = None
