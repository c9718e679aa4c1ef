"""How well drones know where they are, by what tells them, and what that does to the map: docs/localization.md.

    PYTHONPATH=.:tests .venv/bin/python -m faults.localization_study FOLDER [sensors|missions]

Flies along a given path with each sensor, and the same mission with each source of poses (`localization_flights`), as
``covrecon run`` does. What lies in FOLDER already is not flown again. Each table of the page is written anew by its
part alone.
"""

from __future__ import annotations

import asyncio
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

import numpy as np

from agents.localization.choice import make_pose_source
from agents.localization.motion_capture import MotionCapture
from agents.localization.pose_filter import PoseFilter, largest_deviation
from agents.localization.registration import MAP_SD_M, MAP_SD_RAD, ScanRegistration
from agents.vehicles.vehicle import Telemetry
from faults.localization_flights import NOISE, fly_all
from faults.measured_page import write_measured
from protocol.bus import Bus
from protocol.geometry import Floats
from protocol.localization_settings import CaptureNoise, Lidar, Localization
from protocol.messages import ExternalPose
from protocol.mission import Drone, Mission, Simulation
from protocol.separation import SIGMAS
from sim_bridge.estimate import EstimateError
from sim_bridge.lidar import directions, measure
from sim_bridge.motion_capture import SimulatedCapture
from sim_bridge.scenes.cache import scene_cache
from sim_bridge.scenes.lighting import ray_caster
from sim_bridge.scenes.scene import load_scene

Pattern = Callable[[np.random.Generator, Lidar], Floats]

TICK_S = 0.05
SCAN_TICKS = 2
SCENE = "living_room"
SECONDS = (60, 300)
PAGE = Path("docs/localization.md")


@dataclass(frozen=True, slots=True)
class Track:
    """One flight along the path."""

    final_m: float
    rms_m: float
    max_m: float
    yaw_max_rad: float
    told_m: float
    """Mean standard deviation that was told."""
    beyond: float
    """Share of ticks with an error of more than `SIGMAS` of it."""
    refused: int
    scan_ms: float
    scan_p95_ms: float


# --- sensors ---------------------------------------------------------------------------------------------------------


def rings(_generator: np.random.Generator, lidar: Lidar) -> Floats:
    """Forty rings that are the same in every scan."""
    count = lidar.rays // 40
    low, high = lidar.elevation_rad
    elevation, azimuth = (
        grid.ravel()
        for grid in np.meshgrid(np.linspace(low, high, 40), np.linspace(-math.pi, math.pi, count, endpoint=False))
    )
    across = np.cos(elevation)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])


def depth_camera(generator: np.random.Generator, lidar: Lidar) -> Floats:
    """Random pixels of one that looks down, 74 by 45 degrees."""
    image = generator.uniform(-1.0, 1.0, (lidar.rays, 2)) * (0.42, 0.75)
    rays = np.column_stack([image, -np.ones(lidar.rays)])
    unit: Floats = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


SENSORS: Mapping[str, Pattern | None] = {
    "vehicle's estimate": None,
    "non-repetitive lidar": directions,
    "fixed rings": rings,
    "depth camera that looks down": depth_camera,
}
CAPTURES: Mapping[str, CaptureNoise] = {
    "motion capture": CaptureNoise(),
    "motion capture, out of sight": CaptureNoise(dropouts_per_min=6.0, dropout_s=2.0),
}
"""Out of sight: for two seconds, six times a minute in the mean."""


# --- along a path ----------------------------------------------------------------------------------------------------


def path(time_s: float) -> Floats:
    """(5,) round and round the room at 0.4 m/s in the mean, 0.6 at most, turning all the time."""
    return np.array([
        1.8 * math.sin(0.28 * time_s),
        1.5 * math.cos(0.2 * time_s) - 0.5,
        1.6 + 0.5 * math.sin(0.15 * time_s),
        math.remainder(0.3 * math.sin(0.1 * time_s) + 0.05 * time_s, math.tau),
        1.3,
    ])  # fmt: skip


def path_velocity(time_s: float) -> Floats:
    step = 1e-4
    change = path(time_s + step) - path(time_s - step)
    change[3] = math.remainder(change[3], math.tau)
    return change / (2 * step)


def fly_path(pattern: Pattern | None, seconds: int, seed: int = 1) -> Track:
    """As `agents.localization.lidar` does, without processes and at once."""
    lidar, error = Lidar(), EstimateError(NOISE, seed, 1, TICK_S)
    caster = ray_caster(load_scene(SCENE, relative_to=Path(), cache=scene_cache()).triangles)
    scans = ScanRegistration(lidar)
    located = PoseFilter(0, path(0.0)[:4], MAP_SD_M, MAP_SD_RAD, 0.05)
    errors, yaws, told, spent = [], [], [], []
    refused, before = 0, path_velocity(0.0)
    for tick in range(1, round(seconds / TICK_S) + 1):
        error.step()
        time_s = tick * TICK_S
        truth, velocity = path(time_s), error.velocity(path_velocity(time_s))
        located.advance(tick, (velocity + before)[:4] / 2, TICK_S)
        before = velocity
        pose, deviation_m = error.pose(truth), error.deviations[0]
        if pattern is not None:
            if tick % SCAN_TICKS == 0:
                generator = np.random.default_rng([seed, tick])
                points = measure(caster, pattern(generator, lidar), truth, lidar, generator)
                began_s = time.thread_time()
                result = scans.register(points, located.pose)
                taken = result.fits and located.correct(tick, result.pose, result.covariance)
                if taken:
                    scans.keep(located.pose)
                spent.append(time.thread_time() - began_s)
                refused += not taken
            pose, deviation_m = located.pose, math.hypot(largest_deviation(located.covariance[:3, :3]), MAP_SD_M)
        errors.append(math.dist(pose[:3], truth[:3]))
        yaws.append(abs(math.remainder(pose[3] - truth[3], math.tau)))
        told.append(deviation_m)
    off, sure = np.array(errors), np.array(told)
    cost = 1e3 * np.array(spent or [0.0])
    return Track(
        off[-1], math.sqrt((off**2).mean()), off.max(), max(yaws), sure.mean(), float((off > SIGMAS * sure).mean()),
        refused, cost.mean(), float(np.percentile(cost, 95)),
    )  # fmt: skip


class OneHandlerBus:
    """All of a bus that motion capture's poses take, without one: what is said is there at once."""

    def on(self, _topic: object, handler: Callable[[ExternalPose], None], _drone: int) -> None:
        self.deliver = handler

    async def until(self, condition: Callable[[], bool], _timeout_s: float) -> bool:
        return condition()


async def fly_path_seen(noise: CaptureNoise, seconds: int, seed: int = 1) -> Track:
    """With the agent's own source of poses; the first second, in which it finds itself, does not count."""
    mission = Mission(
        seed=seed,
        duration_s=seconds,
        simulation=Simulation(estimate=NOISE, mocap=noise),
        localization=Localization(source="mocap"),
        drones=(Drone(id=1, start=(0.0, 1.0, 2.0, 0.0, 1.3)),),
    )
    capture, bus, error = SimulatedCapture(mission), OneHandlerBus(), EstimateError(NOISE, seed, 1, TICK_S)
    source = make_pose_source(mission, 1, cast("Bus", bus), lockstep=True)
    assert isinstance(source, MotionCapture)
    errors, yaws, told = [], [], []
    for tick in range(round(seconds / TICK_S) + 1):
        time_s = tick * TICK_S
        truth = path(time_s)
        for seen in capture.look(tick, {1: truth}):
            bus.deliver(seen)
        believed = Telemetry(error.pose(truth), error.velocity(path_velocity(time_s)), 1.0, time_s)
        located = await source.locate(tick, believed)
        assert located is not None
        error.step()
        if time_s > 1.0:
            errors.append(math.dist(located.pose[:3], truth[:3]))
            yaws.append(abs(math.remainder(located.pose[3] - truth[3], math.tau)))
            told.append(located.position_sd_m)
    off, sure = np.array(errors), np.array(told)
    return Track(
        off[-1], math.sqrt((off**2).mean()), off.max(), max(yaws), sure.mean(), float((off > SIGMAS * sure).mean()),
        source.counts.refused, 0.0, 0.0,
    )  # fmt: skip


# --- the page --------------------------------------------------------------------------------------------------------


def cm(metres: float | None) -> str:
    return "–" if metres is None else f"{100 * metres:.1f}"


EXTREMES = "final / rms / max"


def sensors(folder: Path) -> Iterator[str]:
    lines = [
        f"| poses from | s | error {EXTREMES}, cm | yaw max, ° | told, cm | beyond 3 told | refused | CPU ms (p95) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for seconds in SECONDS:
        for name in (*SENSORS, *CAPTURES):
            file = folder / f"track-{name.replace(' ', '-')}-{seconds}.json"
            if not file.exists():
                flown = (
                    asyncio.run(fly_path_seen(CAPTURES[name], seconds))
                    if name in CAPTURES
                    else fly_path(SENSORS[name], seconds)
                )
                file.write_text(json.dumps(asdict(flown)))
            track = Track(**json.loads(file.read_text()))
            cost = f"{track.scan_ms:.0f} ({track.scan_p95_ms:.0f})" if track.scan_ms else "–"
            lines.append(
                f"| {name} | {seconds} | {cm(track.final_m)} / {cm(track.rms_m)} / {cm(track.max_m)}"
                f" | {math.degrees(track.yaw_max_rad):.2f} | {cm(track.told_m)} | {track.beyond:.1%}"
                f" | {track.refused} | {cost} |"
            )
    yield "\n".join(lines)


def missions(folder: Path) -> Iterator[str]:
    return fly_all(folder, SECONDS[0])


PARTS: Mapping[str, Callable[[Path], Iterator[str]]] = {"sensors": sensors, "missions": missions}


def main(arguments: list[str]) -> None:
    folder, *asked = arguments
    Path(folder).mkdir(parents=True, exist_ok=True)
    for part in asked or PARTS:
        for measured in PARTS[part](Path(folder)):
            write_measured(PAGE, measured, part)
            print(measured)


if __name__ == "__main__":
    main(sys.argv[1:])
