"""What a replay may change of the mission that was flown: what makes phi and map from states and images."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from typing import Any

from protocol.errors import MissionError
from protocol.mission import Mission
from protocol.mission_faults import check

REPLAYABLE = ("feedback", "reconstruction", "sensing", "target")
"""Tables of the mission. Everything else is flown already: where the drones were, and what they photographed."""


def with_settings(mission: Mission, assignments: Sequence[str]) -> Mission:
    """``mission`` with assignments like ``feedback.kappa=0.5``; a value is TOML, or a bare word for a text.

    Raises:
        MissionError: one fault a line.
    """
    raw = mission.model_dump(mode="json")
    faults = [fault for assignment in assignments if (fault := _assign(raw, assignment))]
    if faults:
        raise MissionError(faults)
    changed, found = check(raw)
    if changed is None or found:
        raise MissionError([": ".join(part for part in (fault.key, fault.message) if part) for fault in found])
    return changed


def _assign(raw: dict[str, Any], assignment: str) -> str:
    """Why it cannot be done; empty when it is."""
    key, equals, text = (part.strip() for part in assignment.partition("="))
    table, *names = key.split(".")
    if not (equals and names):
        return f"{assignment}: must be like feedback.kappa=0.5"
    if table not in REPLAYABLE:
        return f"{key}: is flown already; a replay can change {', '.join(REPLAYABLE)}"
    place = raw[table]
    for name in names[:-1]:
        place = place.get(name)
        if not isinstance(place, dict):
            return f"{key}: {name} is no table"
    place[names[-1]] = value_of(text)
    return ""


def value_of(text: str) -> Any:
    """What the right side of an assignment says: TOML, or a bare word for a text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except ValueError:
        return text
