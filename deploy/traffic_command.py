"""``covrecon traffic``: what a mission puts on its radio links, before anybody carries them to the field."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from cyclopts.validators import Number

if TYPE_CHECKING:
    from protocol.mission import Mission
    from protocol.traffic import Direction, Plan, Traffic

LINKS_MBPS = (5, 20, 50)
"""What is left of a radio link in practice: a far one, a near one, and a good access point for all together."""
AMPLE, TIGHT = 0.5, 0.8
"""Shares of a link up to which it carries the traffic with room for losses, and beyond which states come late."""
ACKNOWLEDGEMENTS = "acknowledgements"

Rows = dict[str, dict[str, float]]
"""By topic: bytes a second up and down, and messages a second."""


def traffic(
    mission: Annotated[Path, Parameter(help="Mission file (TOML).")],
    /,
    *,
    drones: Annotated[
        int | None, Parameter(help="Team size, as for covrecon run.", validator=Number(gte=1, lte=255))
    ] = None,
    jpeg_kb: Annotated[float | None, Parameter(validator=Number(gt=0), show_default=False)] = None,
    speed_mps: Annotated[float | None, Parameter(validator=Number(gte=0), show_default=False)] = None,
    as_json: Annotated[bool, Parameter(name="--json", negative="", show_default=False)] = False,
) -> None:
    """Say how many kB/s a mission puts on each drone's link and on the radio that all share.

    Counted are IP packets, with what TLS and TCP add, in steady flight. What is fetched by a drone that joins, or
    after a link was cut, comes on top for a while (docs/scaling.md).

    ```
    covrecon traffic missions/px4.toml                       # without images
    covrecon traffic missions/px4.toml --jpeg-kb 80          # each drone sends its camera's images
    covrecon traffic missions/demo.toml --drones 32 --json
    ```

    Parameters
    ----------
    jpeg_kb
        Size of one image; every drone then sends its own. Without it, only drones that have a real camera do, with
        images as large as the built-in room's.
    speed_mps
        Mean speed, which decides how many images there are. Without it, as fast as the mission allows.
    as_json
        The same figures for machines.
    """
    from protocol.mission_file import load_mission
    from protocol.traffic import Plan

    checked = load_mission(mission, drones=drones)
    plan = Plan(jpeg_bytes=None if jpeg_kb is None else round(jpeg_kb * 1e3), speed_mps=speed_mps)
    told = figures(checked, plan)
    sys.stdout.write(json.dumps(told, indent=2) + "\n" if as_json else "\n".join(_lines(told)) + "\n")


def figures(mission: Mission, plan: Plan) -> dict[str, Any]:
    """Of the drone with most to carry, and of all together."""
    from protocol.aggregator import is_gathered
    from protocol.traffic import radio_bytes_per_s, traffic_of

    loads = {drone.id: traffic_of(mission, drone.id, plan) for drone in mission.drones}
    busiest = max(loads, key=lambda drone: loads[drone].bytes_per_s("up") + loads[drone].bytes_per_s("down"))
    up, down = (loads[busiest].bytes_per_s(direction) for direction in ("up", "down"))
    radio = radio_bytes_per_s(mission, plan)
    return {
        "mission": mission.name,
        "drones": len(mission.drones),
        "states_gathered": is_gathered(mission, lockstep=False),
        "drone": busiest,
        "topics": _rows(loads[busiest]),
        "up_bytes_per_s": round(up),
        "down_bytes_per_s": round(down),
        "radio_bytes_per_s": round(radio),
        "shares": {
            f"{link} Mbit/s": {name: round(8e-6 * load / link, 4) for name, load in
                               (("up", up), ("down", down), ("radio", radio))}
            for link in LINKS_MBPS
        },
    }  # fmt: skip


def _rows(load: Traffic) -> Rows:
    rows: Rows = {}
    for flow in load.flows:
        row = rows.setdefault(flow.topic, {"up": 0.0, "down": 0.0, "messages": 0.0})
        row[flow.direction] += flow.bytes_per_s
        row["messages"] += flow.rate_hz
    directions: tuple[Direction, ...] = ("up", "down")
    rows[ACKNOWLEDGEMENTS] = {direction: load.acknowledgements(direction) for direction in directions}
    return {name: {column: round(value, 1) for column, value in row.items()} for name, row in rows.items()}


def _lines(told: dict[str, Any]) -> list[str]:
    states = "gathered by the router" if told["states_gathered"] else "each drone's heard by every other"
    lines = [
        f"{told['mission']}: {told['drones']} drones, states {states}; the link of drone {told['drone']}:",
        f"{'topic':24}{'messages/s':>12}{'up kB/s':>12}{'down kB/s':>12}",
    ]
    for name, row in told["topics"].items():
        messages = f"{row['messages']:.1f}" if "messages" in row else ""
        lines.append(f"{name:24}{messages:>12}{_kilo(row['up']):>12}{_kilo(row['down']):>12}")
    lines += [
        f"{'in all':36}{_kilo(told['up_bytes_per_s']):>12}{_kilo(told['down_bytes_per_s']):>12}",
        f"{'the radio of all drones':36}{_kilo(told['radio_bytes_per_s']):>24}",
        "",
        f"{'share of a link of':24}{'up':>12}{'down':>12}{'radio of all':>16}",
    ]
    for link, shares in told["shares"].items():
        row = "".join(f"{100 * share:>11.1f}%" for share in (shares["up"], shares["down"]))
        lines.append(f"{link:24}{row}{100 * shares['radio']:>15.1f}%  {_verdict(shares['radio'])}")
    return lines


def _kilo(bytes_per_s: float) -> str:
    return f"{bytes_per_s / 1e3:.2f}" if bytes_per_s else ""


def _verdict(share: float) -> str:
    if share <= AMPLE:
        return "carries them all"
    return "leaves no room for losses" if share <= TIGHT else "too little for all"
