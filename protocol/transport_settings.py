"""How the processes of a mission reach each other: ``[transport]`` of a mission file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from protocol.endpoints import why_refused
from protocol.settings import Settings


class Transport(Settings):
    """On one machine nothing need be said. Other computers come in by ``tls/`` alone (docs/fleet.md)."""

    endpoint: str = ""
    """zenoh endpoint at which the router listens and to which the others connect; empty: a unix socket in a private
    folder. One that other computers reach is ``tls/<address>:<port>``, and wants ``credentials``."""
    alternatives: tuple[str, ...] = ()
    """Endpoints of further routers, which processes try when the first does not answer."""
    uplinks: tuple[str, ...] = ()
    """Endpoints of other sites' routers to which this site's router connects."""
    credentials: str = ""
    """Folder with the certificates that `covrecon pki` makes, relative to the mission file."""
    aggregate_above: Annotated[int, Field(ge=0, le=255)] = 8
    """With more drones than this the router gathers the team's states, so that each drone hears one message a tick
    instead of one from every other; 0: always."""

    def faults(self) -> list[str]:
        """Endpoints that strangers could reach, each with its key and what to do."""
        places = {"endpoint": self.endpoint}
        places |= {f"alternatives.{index}": place for index, place in enumerate(self.alternatives)}
        places |= {f"uplinks.{index}": place for index, place in enumerate(self.uplinks)}
        reasons = {key: why_refused(place, certified=bool(self.credentials)) for key, place in places.items()}
        return [f"transport.{key}: {places[key]} {reason}" for key, reason in reasons.items() if reason]
