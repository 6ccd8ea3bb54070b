"""A clock over the times of a scene, from 0 to 1: it plays, loops, and can be set."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Timeline:
    """The time that is shown.

    Attributes:
        time: in [0, 1] when the clock read ``since``.
        since: seconds of a monotonic clock.
        playing: whether time passes.
        loops: whether it begins again after 1; else it stops there.
        speed: factor of the speed of the recording.
        seconds: that the recording takes from time 0 to 1.
    """

    time: float = 0.0
    since: float = 0.0
    playing: bool = False
    loops: bool = True
    speed: float = 1.0
    seconds: float = 4.0

    def at(self, clock: float) -> float:
        """Return the time in [0, 1] when the clock reads ``clock``."""
        if not self.playing:
            return self.time
        passed = self.time + max(clock - self.since, 0.0) * self.speed / max(self.seconds, 1e-6)
        return passed % 1.0 if self.loops and passed > 1 else min(passed, 1.0)

    def is_over(self, clock: float) -> bool:
        """Return whether it plays without a loop and has reached the end."""
        return self.playing and not self.loops and self.at(clock) >= 1.0

    def moved(self, time: float, clock: float) -> Timeline:
        """Return the timeline set to ``time``; it plays on if it does."""
        return replace(self, time=min(max(time, 0.0), 1.0), since=clock)

    def changed(self, clock: float, **changes: bool | float) -> Timeline:
        """Return the timeline with other ``playing``, ``loops``, ``speed`` or ``seconds``; the time does not jump.

        Who plays from the end begins at 0.
        """
        now = replace(self, time=self.at(clock), since=clock)
        if changes.get("playing") and now.time >= 1.0:
            now = replace(now, time=0.0)
        return replace(now, **changes)  # type: ignore[arg-type]
