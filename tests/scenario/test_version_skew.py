"""One flight of three releases: this one, one that is a minor version ahead, and one of another major version."""

from __future__ import annotations

from pathlib import Path

import pytest

from faults.processes import Flight, fly, small_mission

pytestmark = [pytest.mark.light, pytest.mark.timeout(180)]

THIS, NEWER, FOREIGN = 1, 3, 5
"""Ids of drones of the three releases; the fourth is of this one too."""
START_PATIENCE_S = 6.0
"""The start waits so long for the two that come later."""


def of_another_release(flight: Flight, drone: int, kind: str) -> None:
    """Start this drone's process as another release has it."""
    words = list(flight.commands[f"drone-{drone}"])
    place = words.index("-m")
    words[place : place + 2] = ["-m", "faults.other_release", kind, words[place + 1]]
    flight.commands[f"drone-{drone}"] = tuple(words)
    flight.start(f"drone-{drone}")


async def test_minor_versions_fly_together_and_another_major_one_is_refused_on_both_sides(tmp_path: Path) -> None:
    mission = small_mission(tmp_path, 4, patience_s=START_PATIENCE_S)
    async with fly(mission, tmp_path, late=(f"drone-{NEWER}", f"drone-{FOREIGN}")) as flight:
        of_another_release(flight, NEWER, "minor")
        of_another_release(flight, FOREIGN, "major")
        states = flight.monitor.states
        await flight.until(
            lambda: NEWER in states and states[NEWER].mode != "joining", "the newer drone to have phi", 60
        )
        await flight.flying(3)  # which the silence of the foreign one does not let get far

        newer, this = states[NEWER], states[THIS]
        assert newer.importance < 0.99
        assert newer.importance == pytest.approx(this.importance, abs=0.02), "a few ticks apart"
        assert newer.replica.missing == 0
        assert FOREIGN not in states
        ground = (flight.run / "logs" / "ground.log").read_text().splitlines()
        heard = (flight.run / "logs" / f"drone-{FOREIGN}.log").read_text()
    (said,) = [line for line in ground if "ERROR" in line and "wire version" in line]
    assert (
        f"link: drone/{FOREIGN}/event: event: wire version 2, this process speaks 1: install the same release" in said
    )
    assert "link: clock/tick: tick: wire version 1, this process speaks 2: install the same release" in heard
