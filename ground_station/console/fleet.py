"""One row of the fleet table for each drone: what an operator must see at a glance, and what to worry about."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

from ground_station.console.constraints import all_in_words, margin
from protocol.messages import Control, DroneState, Mode
from protocol.separation import SIGMAS
from protocol.vehicle_settings import Vehicles

Severity = Literal["good", "notice", "warning", "bad"]
SEVERITIES: Final[tuple[Severity, ...]] = ("good", "notice", "warning", "bad")

SILENT_S: Final = 1.0
"""States come 20 times a second; in lockstep a tick may wait for a map update."""
DEFAULTS: Final = Vehicles()

_MODES: Final[dict[Mode, tuple[Severity, str]]] = {
    "starting": ("notice", "on the ground or taking off"),
    "flying": ("good", ""),
    "braking": ("warning", "no velocity keeps all limits"),
    "joining": ("notice", "fetches the importance"),
    "holding": ("notice", "holds its place"),
    "returning": ("notice", "returns to its start"),
    "landing": ("notice", "comes down"),
    "landed": ("notice", "stands on the ground"),
    "yielded": ("warning", "a pilot or the autopilot flies it"),
}


@dataclass(frozen=True, slots=True)
class FleetRow:
    drone: int
    mode: str
    """As the state says; "waiting" before the first, "lost" when its process is gone, "ended" when it may be."""
    severity: Severity
    """Of the worst of ``reasons``."""
    reasons: tuple[str, ...]
    """Why it is not good, in words, worst first; plain text."""
    battery: float | None
    """0 to 1; None before the first state, likewise below."""
    link_age_s: float | None
    active: str
    """Rows of the QP that hold with equality, in words."""
    slack: float | None
    fallbacks: int | None
    solve_ms: float | None
    separation_margin_m2: float | None
    """None also when there is nobody to keep away from."""


def fleet_row(
    drone: int,
    state: DroneState | None,
    link_age_s: float | None,
    alive: bool,
    vehicles: Vehicles = DEFAULTS,
    *,
    finished: bool = False,
) -> FleetRow:
    """``link_age_s``: since ``state`` came; ``alive``: whether its process has a liveliness token; ``vehicles``: the
    mission's, for when a battery is low and telemetry is stale; ``finished``: whether the mission is over."""
    if state is None:
        waiting = "not heard yet" if alive else "its process is not there yet"
        return FleetRow(drone, "waiting", "notice", (waiting,), None, None, "", None, None, None, None)
    control = state.control
    # Simulated vehicles fall asleep where they are; real ones are brought down first.
    ended = finished and not alive and vehicles.kind == "simulated"
    if ended:
        found: list[tuple[Severity, str]] = [("notice", "its process has ended with the mission")]
    else:
        found = [*_of_link(state, link_age_s, alive), *_of_state(state, vehicles)]
        found += [] if control is None else _of_control(control, state.position_sd_m, vehicles)
    found.sort(key=lambda worry: SEVERITIES.index(worry[0]), reverse=True)
    return FleetRow(
        drone=drone,
        mode=state.mode if alive or state.mode == "landed" else "ended" if ended else "lost",
        severity=found[0][0] if found else "good",
        reasons=tuple(reason for _, reason in found),
        battery=state.battery,
        link_age_s=link_age_s,
        active=all_in_words(control.active) if control else "",
        slack=control.slack if control else None,
        fallbacks=control.fallbacks if control else None,
        solve_ms=1e3 * control.solve_s if control else None,
        separation_margin_m2=margin(control.separation_margin_m2) if control else None,
    )


def _of_link(state: DroneState, link_age_s: float | None, alive: bool) -> Iterator[tuple[Severity, str]]:
    if state.mode == "landed":  # who has landed may leave
        return
    if not alive:
        yield "bad", "its process is gone"
    elif link_age_s is not None and link_age_s > SILENT_S:
        yield "warning", f"not heard for {link_age_s:.0f} s"


def _of_state(state: DroneState, vehicles: Vehicles) -> Iterator[tuple[Severity, str]]:
    severity, reason = _MODES[state.mode]
    if reason:
        yield severity, reason
    if state.battery <= vehicles.battery_critical:
        yield "bad", "battery critical"
    elif state.battery <= vehicles.battery_low:
        yield "warning", "battery low"
    if state.blind_s > 0:
        yield "warning", "its vehicle is not heard"
    if state.replica.missing and state.mode == "flying":
        yield "notice", "its importance is not complete"


def _of_control(control: Control, position_sd_m: float, vehicles: Vehicles) -> Iterator[tuple[Severity, str]]:
    if control.outcome not in ("solved", "none"):
        yield "warning", f"solver: {control.outcome.replace('_', ' ')}"
    if control.separation_margin_m2 < 0:
        yield "bad", "closer to another than allowed"
    if control.region_margin_m < -SIGMAS * position_sd_m:
        yield "warning", "outside the flight region"
    elif control.region_margin_m < 0:
        yield "notice", "too unsure of its place for where it is in the flight region"
    if control.obstacle_margin_m < 0:
        yield "notice", "leaves what its map has learned of"
    if control.pitch_margin_rad2 < 0:
        yield "warning", "camera outside its range"
    if control.telemetry_age_s > vehicles.telemetry_stale_s:
        yield "warning", f"telemetry {control.telemetry_age_s:.1f} s old"
