"""How drones keep clear of what stands in the room: the table ``[flight.obstacles]``."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from protocol.settings import Metres, Positive, Settings


class Obstacles(Settings):
    """Barriers from the map that is being made: what was not seen free is an obstacle (docs/obstacles.md)."""

    enabled: bool = False
    cell_m: Annotated[float, Field(ge=0.02, le=1)] = 0.1
    """Edge of the cells that are free or not."""
    clear_above_m: Metres | None = None
    """Height above which the crew vouches that nothing stands within the flight region; left out: the top of the
    target box."""
    period_s: Positive = 0.5
    """Mission time between two maps of free cells."""
    stale_s: Positive = 5.0
    """A drone that has not heard one for so long holds; what it knows to be free stays so."""
    stuck_s: Positive = 8.0
    """A drone that obstacles keep at its place for so long climbs to where nothing stands, and begins anew."""
