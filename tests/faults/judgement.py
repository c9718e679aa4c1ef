"""What must hold of a flight once its fault is over: it heals, all replicas are equal, nothing was lost, it ends."""

from __future__ import annotations

import asyncio
import json
import math
import signal
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any, TypeAlias

from faults.processes import END_S, Flight
from faults.witness import true_positions
from ground_station.journal import JOURNAL_FILE, Journal
from ground_station.keyframe_log import KEYFRAMES_FILE, KeyframeLog
from ground_station.results import SUMMARY_FILE
from ground_station.separation import nearest_distances

Figures: TypeAlias = dict[str, Any]

HEAL_S = 30.0
"""For everybody to be back after a fault; a process that is started again takes most of it to import."""
EQUAL_S = 15.0
"""For the digests to find and repair what drifted."""
MISSION_S = 180.0
"""For J to fall to its target."""
TOLERANCES = 4.0
"""A block may differ by so many `Replication.tolerance`, root mean square: a digest's sketch only estimates it."""


async def judge(flight: Flight, figures: Figures, *, new_epoch: bool) -> list[str]:
    """Violations; ``figures`` gets what was measured. Raises `HarnessError` when a bound of time is broken."""
    monitor = flight.monitor
    figures["healed_in_s"] = round(await flight.until(monitor.is_healed, "the flight to heal", HEAL_S), 1)
    violations = await compare_replicas(flight, figures)
    violations += await _end(flight, figures)
    violations += monitor.contradictions
    violations += judge_separation(flight, figures)
    violations += judge_journal(flight, figures, new_epoch=new_epoch)
    summary = json.loads((flight.run / SUMMARY_FILE).read_text())
    figures |= {"J": round(summary["J"], 3), "jumps": summary["jumps"], "ticks": summary["ticks"]}
    if summary["J"] >= flight.mission.stop_below:
        violations.append(f"J ended at {summary['J']}: {summary['exit_reason']}")
    return violations


async def compare_replicas(flight: Flight, figures: Figures, lost: Collection[int] = ()) -> list[str]:
    """Wait until all replicas, but those of drones that are ``lost``, are equal within tolerance; a violation if they
    never are."""
    clock = asyncio.get_running_loop().time
    deadline = clock() + EQUAL_S
    allowed = TOLERANCES * flight.mission.replication.tolerance
    comparison = await flight.monitor.compare(lost)
    while (comparison is None or comparison.worst_rms > allowed) and clock() < deadline:
        comparison = await flight.monitor.compare(lost)
    if comparison is None:
        return ["not all replicas could be asked for phi at the same tick, jump and epoch"]
    figures |= {"bit_equal": comparison.bit_equal, "worst_rms": float(f"{comparison.worst_rms:.3g}")}
    return [] if comparison.worst_rms <= allowed else [f"replicas differ by {comparison.worst_rms:.3g}"]


async def _end(flight: Flight, figures: Figures) -> list[str]:
    """The mission ends by itself, and all processes with it."""
    await flight.until(lambda: flight.code("ground") is not None, "the mission to end", MISSION_S)
    others = ["sim", *flight.drones]
    waited_s = await flight.until(lambda: all(flight.code(name) is not None for name in others), "all to end", END_S)
    figures["others_ended_in_s"] = round(waited_s, 1)
    flight.signal("router", signal.SIGTERM)
    await flight.until(lambda: flight.code("router") is not None, "the router to end", END_S)
    return [f"{name} ended with exit code {flight.code(name)}" for name in ("ground", *others) if flight.code(name)]


def judge_separation(flight: Flight, figures: Figures) -> list[str]:
    """By the true positions at every tick."""
    smallest, at = math.inf, 0
    for tick, positions in true_positions(flight.run):
        nearest = min(nearest_distances(dict(enumerate(positions.tolist()))).values())
        if nearest < smallest:
            smallest, at = nearest, tick
    if smallest < math.inf:
        figures["min_separation_m"] = round(smallest, 3)
    wanted = flight.mission.flight.separation_m
    return [f"drones {smallest:.3f} m apart at tick {at}"] if smallest < wanted else []


def judge_journal(flight: Flight, figures: Figures, *, new_epoch: bool) -> list[str]:
    """Every jump that was published is in the journal as it was published, and no replica has taken in any other."""
    violations = []
    with Journal(flight.run / JOURNAL_FILE) as journal:
        epochs = {epoch for epoch, _ in flight.monitor.jumps} | {journal.epoch}
        figures |= {"epochs": len(epochs), "acknowledged": len(flight.monitor.jumps)}
        if len(epochs) != (2 if new_epoch else 1):
            violations.append(f"{len(epochs)} epochs")
        for (epoch, sequence), encoded in flight.monitor.jumps.items():
            kept = epoch == journal.epoch and sequence >= journal.first_sequence
            if kept and journal.page(sequence, sequence + 1) != (encoded,):
                violations.append(f"jump {sequence} was published and is not in the journal")
        for drone, state in flight.monitor.states.items():
            replica = state.replica
            if (replica.epoch, replica.next_jump) > (journal.epoch, journal.next_sequence):
                violations.append(f"drone {drone} knows jump {replica.next_jump - 1} of epoch {replica.epoch}")
    return violations


def kept_keyframes(folder: Path) -> int:
    """In the log of a run's folder that the map is made of; each drone's without a gap."""
    with KeyframeLog(folder / KEYFRAMES_FILE) as log:
        kept = [keyframe for _, keyframe in log.read(0, log.end)]
    numbers: dict[int, list[int]] = {}
    for keyframe in kept:
        numbers.setdefault(keyframe.drone, []).append(keyframe.sequence)
    assert all(sorted(found) == list(range(len(found))) for found in numbers.values()), Counter(numbers)
    return len(kept)
