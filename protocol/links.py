"""Which way a process takes to its mission: the endpoint, and for one that other computers reach, its certificate."""

from __future__ import annotations

import logging
from datetime import UTC, datetime
from pathlib import Path

from protocol.credentials import OPERATOR, find_operator, load_credentials
from protocol.endpoints import CERTIFIED
from protocol.errors import BusError
from protocol.mission import Mission
from protocol.session import Link

log = logging.getLogger(__name__)


def link_of(mission: Mission, identity: str, *, endpoint: str = "", now: datetime | None = None) -> Link:
    """The way of the process ``identity`` (`protocol.credentials`); ``operator`` is whichever the folder has.

    Args:
        endpoint: instead of the mission's; then there are no alternatives to it.
        now: by which certificates are judged; the machine's time if it is not given.

    Raises:
        CredentialsError: it has no certificate that the others would accept.
        BusError: neither the mission nor ``endpoint`` says where to go.
    """
    transport = mission.transport
    alternatives = () if endpoint else transport.alternatives
    endpoint = endpoint or transport.endpoint
    if not endpoint:
        raise BusError("no endpoint: set transport.endpoint in the mission, or give --endpoint")
    link = Link(endpoint, alternatives)
    if not transport.credentials or not any(place.startswith(f"{CERTIFIED}/") for place in link.endpoints):
        return link
    folder = Path(transport.credentials)
    if identity == OPERATOR:
        identity = find_operator(folder)
    credentials = load_credentials(folder, identity, now=now or datetime.now(UTC))
    if credentials.warning:
        log.warning("%s", credentials.warning)
    return Link(endpoint, alternatives, credentials)
