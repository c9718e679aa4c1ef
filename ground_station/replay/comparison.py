"""Whether a replay came to what the flight came to, and if not, what was different first: all later differences follow
from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from protocol.messages import Jump


@dataclass(slots=True)
class Comparison:
    """Filled as a replay goes on; the flight's values come first."""

    difference: str = ""
    """The first, in words; empty while there is none."""
    looks: int = 0
    """Map updates compared."""
    jumps: int = 0
    """Jumps compared."""

    def note(self, tick: int, text: str) -> None:
        """A difference that begins at ``tick``."""
        self.difference = self.difference or f"tick {tick}: {text}"

    def look(self, tick: int, flown: float, replayed: float) -> None:
        """J when the map was looked at."""
        self.looks += 1
        if flown != replayed:
            self.note(tick, f"J was {flown!r}, and is {replayed!r} in the replay")

    def jump(self, look: int, flown: Jump, replayed: Jump | None) -> None:
        """The jump from the map of tick ``look``; None when that map gives none now."""
        self.jumps += 1
        name = f"jump {flown.sequence}, from the map of tick {look},"
        if replayed is None:
            self.note(flown.tick, f"{name} does not come about in the replay")
        elif flown.increments.shape != replayed.increments.shape:
            self.note(flown.tick, f"{name} was for {flown.increments.size} positions")
        elif flown.increments.tobytes() != replayed.increments.tobytes():
            apart = np.abs(flown.increments - replayed.increments)
            count = np.count_nonzero(apart)
            self.note(flown.tick, f"{name} differs at {count} of {apart.size} positions, by at most {apart.max():.3g}")

    def end(self, tick: int, summary: Mapping[str, Any], phi_sha256: str, mesh_sha256: str | None) -> None:
        """The final hashes, against those of the flight's ``summary`` (`ground_station.results.Summary.as_json`)."""
        for name, replayed in (("phi", phi_sha256), ("mesh", mesh_sha256)):
            flown = summary.get(f"{name}_sha256")
            if flown != replayed:
                self.note(tick, f"the final {name} was {_short(flown)}, and is {_short(replayed)} in the replay")


def _short(sha256: str | None) -> str:
    return f"{sha256[:16]}..." if sha256 else "none"
