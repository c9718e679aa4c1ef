"""kill -9 of the ground station at random moments of one flight: no jump lost, none taken in twice, no surface lost.

``python -m faults.ground_kills``
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import random
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from faults.judgement import HEAL_S, Figures, compare_replicas, judge_journal, judge_separation
from faults.matrix import Result
from faults.processes import START_S, Flight, HarnessError, fly, small_mission
from ground_station.checkpoint import CHECKPOINT_FILE, load_checkpoint
from ground_station.reconstruction.backends import make_reconstructor

KILLS = 20
DRONES = 2
LONGEST_LIFE_S = 6.0
"""Between the ground station's return to the bus and its next death, uniformly; it needs some seconds to know phi."""
DURATION_S = 1800.0
STOP_BELOW = 1e-6
"""Never reached: the flight lasts as long as it takes."""
SURFACE_LOSS = 0.02
"""Later views move a surface that was seen before, and its area with it."""


def surface_m2(flight: Flight) -> float:
    """Area of the map in the last checkpoint, which a dead ground station left."""
    checkpoint = load_checkpoint(flight.run, flight.mission)
    if checkpoint is None:
        return 0.0
    reconstructor = make_reconstructor(flight.mission)
    reconstructor.restore(checkpoint.map.reconstruction, [])
    mesh = reconstructor.mesh()
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    edges = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(edges, axis=1).sum() / 2)


async def kill_repeatedly(kills: int, folder: Path, say: Callable[[str], None], seed: int = 0) -> Result:
    dice = random.Random(seed)
    figures: Figures = {"kills": kills}
    violations: list[str] = []
    surfaces: list[float] = []
    mission = small_mission(folder, DRONES, stop_below=STOP_BELOW, duration_s=DURATION_S)
    try:
        async with fly(mission, folder) as flight:
            path = flight.run / CHECKPOINT_FILE
            await flight.until(path.exists, "the first checkpoint", START_S)
            for _ in range(kills):
                await asyncio.sleep(dice.uniform(0.0, LONGEST_LIFE_S))
                await flight.kill("ground")
                await flight.until(lambda: "ground" not in flight.monitor.alive, "the death to be noticed", START_S)
                surfaces.append(await asyncio.to_thread(surface_m2, flight))
                say(f"killed at {flight.monitor.tick * mission.tick_s:.1f} s, surface {surfaces[-1]:.2f} m2")
                flight.start("ground")
                await flight.until(lambda: "ground" in flight.monitor.alive, "the ground station", START_S)
            figures["healed_in_s"] = round(await flight.until(flight.monitor.is_healed, "it to heal", HEAL_S), 1)
            violations += await compare_replicas(flight, figures)
            await flight.kill("ground")
            surfaces.append(await asyncio.to_thread(surface_m2, flight))
            violations += flight.monitor.contradictions
            violations += judge_separation(flight, figures) + judge_journal(flight, figures, new_epoch=False)
    except HarnessError as error:
        violations.append(str(error))
    lost = [later / earlier for earlier, later in itertools.pairwise(surfaces) if earlier]
    figures["smallest_surface_after_to_before"] = round(min(lost, default=1.0), 3)
    figures["surface_m2"] = [round(surface, 2) for surface in surfaces]
    if min(lost, default=1.0) < 1.0 - SURFACE_LOSS:
        violations.append("surface of the last checkpoint was lost")
    if violations:
        figures["violations"] = violations
    return Result(f"ground station killed at {kills} random moments", DRONES, not violations, figures)


def fly_with_kills(kills: int, say: Callable[[str], None]) -> Result:
    with TemporaryDirectory() as folder:
        return asyncio.run(kill_repeatedly(kills, Path(folder), say))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m faults.ground_kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=KILLS, help="how many")
    result = fly_with_kills(parser.parse_args().kills, lambda text: print(text, flush=True))
    print(result)
    return 0 if result.held else 1


if __name__ == "__main__":
    sys.exit(main())
