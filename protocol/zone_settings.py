"""Where drones fly within the box of ``[flight]``, and where not: its keys ``boundary`` and ``[[flight.no_fly]]``."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from protocol.polygons import Corner, polygon_fault
from protocol.settings import Metres, Settings

CORNERS_MAX, ZONES_MAX = 64, 64
"""The graph of ways around zones grows with the square of their corners."""
BOUNDARY = "boundary"
"""What the boundary is called among the zones."""


def _simple(corners: tuple[Corner, ...]) -> tuple[Corner, ...]:
    fault = polygon_fault(corners)
    if fault:
        raise ValueError(fault)
    return corners


Polygon = Annotated[
    tuple[tuple[Metres, Metres], ...],
    Field(max_length=CORNERS_MAX),
    AfterValidator(_simple),
]
"""[[x, y], ...], clockwise or not, convex or not; it must not cross itself."""


class NoFly(Settings):
    """A polygon x heights that nobody enters."""

    name: Annotated[str, Field(min_length=1, max_length=40, pattern=r"^[^:]*$")]
    """For people: in messages, on the console, in the report."""
    polygon: Polygon
    """[[x, y], ...], world frame; clockwise or not, convex or not, without crossing itself."""
    lower_m: Metres | None = None
    """Height from which it is forbidden; left out: all below upper_m."""
    upper_m: Metres | None = None
    """Height up to which it is forbidden; left out: all above lower_m."""

    @model_validator(mode="after")
    def _has_height(self) -> NoFly:
        if self.lower_m is not None and self.upper_m is not None and self.lower_m >= self.upper_m:
            raise ValueError(f"upper_m {self.upper_m:g} must exceed lower_m {self.lower_m:g}")
        return self
