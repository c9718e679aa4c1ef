"""What smooth flight costs and brings, before and after: docs/smooth-flight.md.

    PYTHONPATH=.:tests .venv/bin/python -m faults.smooth_study FOLDER [teams]

Teams in one process until J < 0.1; then, unless "teams" is said, flights with cameras that blur until J < 0.5, and the
maps of them, which take minutes. What lies in FOLDER already is not flown again.
"""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from faults.located_team import located
from faults.measured_page import write_measured
from faults.team_flight import TeamFlight
from faults.virtual_loop import run
from ground_station.keyframe_log import NoKeyframes
from ground_station.mapper import Mapper
from protocol.field import VirtualField
from protocol.geometry import Floats
from protocol.map_settings import Feedback
from protocol.messages import Keyframe
from protocol.mission import Controller, Drone, Mission, Simulation
from protocol.operation_settings import Recording
from sim_bridge.camera import Camera
from sim_bridge.exposure import image_rate
from sim_bridge.photographer import Photographer, Shot
from sim_bridge.scenes.cache import scene_cache
from sim_bridge.scenes.scene import Scene, load_scene
from sim_bridge.scenes.truth import write_truth

SCENE = "living_room"
WEIGHTS = (0.0, 0.1)
"""Of `controller.smoothing`: before and after."""
SEEDS = (1, 2, 3)
TEAMS = (2, 4)
LEVELS = (0.5, 0.25, 0.1)
"""Of J."""
LIMIT_S = 600.0
DEAD_BAND_MPS = 0.05
"""A velocity component flips when it comes out of the dead band on the other side than last time."""
EXPOSURE_S = 0.02
TRACE_S = 60.0
PAGE, PICTURE = Path("docs/smooth-flight.md"), Path("docs/images/smooth-flight.png")


def team(count: int, seed: int) -> tuple[Drone, ...]:
    """In a row, at random places beside it and headings."""
    rng = np.random.default_rng(seed)
    return tuple(
        Drone(
            id=k + 1,
            start=(1.5 * (k - (count - 1) / 2), rng.uniform(-1, 1), 2.0, rng.uniform(-3, 3), 1.3),
        )
        for k in range(count)
    )


def flips(speeds: Floats) -> int:
    """Of velocity components over time (ticks, n)."""
    return sum(
        int(np.count_nonzero(np.diff(np.sign(component[np.abs(component) > DEAD_BAND_MPS])))) for component in speeds.T
    )


# --- teams -----------------------------------------------------------------------------------------------------------


def fly(count: int, seed: int, weight: float) -> dict[str, Any]:
    """One flight to the last of `LEVELS`: its figures, J(t), and the first drone's velocity along x to begin with."""
    mission = Mission(drones=team(count, seed), controller=Controller(smoothing=weight))
    flight, dt = TeamFlight(mission), mission.tick_s
    reached: dict[str, tuple[float, float]] = {}
    importance, velocities = [], []
    while len(reached) < len(LEVELS) and flight.tick * dt < LIMIT_S:
        flight.step()
        velocities.append([body.velocity for body in flight.bodies])
        importance.append(flight.importance)
        for level in LEVELS:
            if flight.importance < level:
                reached.setdefault(str(level), (flight.tick * dt, flight.path_m))
    flown = np.array(velocities)
    speeds = flown[..., :3].reshape(len(flown), -1)
    accelerations = np.diff(flown[..., :3], axis=0) / dt
    fx = mission.camera.intrinsics().fx
    motion = [image_rate(velocity, mission.sensing.distance_m) for velocity in flown.reshape(-1, 5)]
    ticks = round(TRACE_S / dt)
    return {
        "reached": reached,
        "flips": flips(speeds) / count / (len(flown) * dt),
        "acceleration": float(np.linalg.norm(accelerations, axis=-1).mean()),
        "jerk": float(np.linalg.norm(np.diff(accelerations, axis=0) / dt, axis=-1).mean()),
        "blur_px": fx * EXPOSURE_S * float(np.mean(motion)),
        "out_of_time": flight.outcomes.count("out_of_time"),
        "decisions": len(flight.outcomes),
        "separation": flight.min_separation,
        "importance": importance[:: round(1 / dt)],
        "trace": flown[:ticks, 0, 0].tolist(),
    }


# --- a map -----------------------------------------------------------------------------------------------------------


class Judge(Photographer):
    """Takes each keyframe a second time, with a shutter that is open for no time."""

    def __init__(self, mission: Mission, scene: Scene) -> None:
        camera = Camera(scene, mission.camera.intrinsics())
        super().__init__(mission, camera)
        simulation = mission.simulation.model_copy(update={"exposure_s": 0.0})
        self._sharp = Photographer(mission.model_copy(update={"simulation": simulation}), camera)
        self.sharpness: list[float] = []

    def take(self, shot: Shot) -> Keyframe:
        keyframe = super().take(shot)
        self.sharpness.append(edges(keyframe) / edges(self._sharp.take(shot)))
        return keyframe


def edges(keyframe: Keyframe) -> float:
    """Mean square of what brightness changes by from pixel to pixel."""
    grey = np.asarray(Image.open(io.BytesIO(keyframe.jpeg)).convert("L"), float)
    return float((np.diff(grey, axis=0) ** 2).mean() + (np.diff(grey, axis=1) ** 2).mean())


def fly_and_map(folder: Path, mission: Mission, photographer: Photographer, scene: Scene) -> dict[str, Any]:
    """Figures of a flight in one process and virtual time, and of the map that is made of its keyframes afterwards."""
    folder.mkdir(parents=True)
    write_truth(scene, mission, folder, cache=scene_cache())

    async def main() -> None:
        async with located(mission, folder, seed=1) as team:
            team.photographer = photographer
            await team.until_over()
            if team.failed():
                raise SystemExit("\n".join(team.failed()))
            keyframes.extend(team.keyframes)

    keyframes: list[Keyframe] = []
    run(main())
    mapper = Mapper(mission, VirtualField.of(mission.target), folder, NoKeyframes())
    for keyframe in keyframes:
        mapper.add([keyframe])
    scores = mapper.finish().scores
    assert scores is not None
    told: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    told |= {"f_score_visible": scores.visible.f, "f_score_objects": scores.objects.f}
    return told | {"keyframes": len(keyframes)}


def fly_with_cameras(folder: Path, weight: float, exposure_s: float) -> dict[str, Any]:
    """Two drones until J < 0.5, and the map of what they saw."""
    mission = Mission(
        duration_s=150,
        stop_below=LEVELS[0],
        simulation=Simulation(scene=SCENE, exposure_s=exposure_s),
        controller=Controller(smoothing=weight),
        feedback=Feedback(method="none"),
        recording=Recording(enabled=False, report=False),
        drones=team(2, SEEDS[0]),
    )
    scene = load_scene(SCENE, relative_to=Path(), cache=scene_cache())
    judge = Judge(mission, scene)
    told = fly_and_map(folder, mission, judge, scene)
    return told | {"sharpness": float(np.mean(judge.sharpness))}


# --- the page --------------------------------------------------------------------------------------------------------


def mean(flights: Sequence[dict[str, Any]], key: str) -> float:
    return float(np.mean([flight[key] for flight in flights]))


def row(name: str, flights: Sequence[dict[str, Any]]) -> str:
    times = [np.mean([flight["reached"][str(level)][0] for flight in flights]) for level in LEVELS]
    ways = [np.mean([flight["reached"][str(level)][1] for flight in flights]) for level in LEVELS]
    late, decided = sum(f["out_of_time"] for f in flights), sum(f["decisions"] for f in flights)
    return (
        f"| {name} | {' / '.join(f'{time:.0f}' for time in times)} | {' / '.join(f'{way:.0f}' for way in ways)}"
        f" | {mean(flights, 'flips'):.2f} | {mean(flights, 'acceleration'):.2f} | {mean(flights, 'jerk'):.1f}"
        f" | {mean(flights, 'blur_px'):.2f} | {late} of {decided} |"
    )


def changes(before: Sequence[dict[str, Any]], after: Sequence[dict[str, Any]]) -> str:
    def change(one: float, other: float) -> str:
        return f"{100 * (other / one - 1):+.0f} %"

    def reached(flights: Sequence[dict[str, Any]], level: float, part: int) -> float:
        return float(np.mean([flight["reached"][str(level)][part] for flight in flights]))

    cells = [
        " / ".join(change(reached(before, level, part), reached(after, level, part)) for level in LEVELS)
        for part in (0, 1)
    ]
    cells += [change(mean(before, key), mean(after, key)) for key in ("flips", "acceleration", "jerk", "blur_px")]
    return f"| change | {' | '.join(cells)} | |"


def draw(flown: dict[tuple[int, int, float], dict[str, Any]]) -> None:
    figure = Figure((10.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for weight, colour in zip(WEIGHTS, ("tab:red", "tab:blue"), strict=True):
        for count, style in zip(TEAMS, ("-", "--"), strict=True):
            for seed in SEEDS:
                label = f"{count} drones, smoothing {weight:g}" if seed == SEEDS[0] else None
                left.plot(flown[count, seed, weight]["importance"], style, color=colour, lw=0.9, label=label)
        trace = flown[TEAMS[0], SEEDS[0], weight]["trace"]
        right.plot(
            np.arange(len(trace)) * TRACE_S / len(trace), trace, color=colour, lw=1, label=f"smoothing {weight:g}"
        )
    left.set(xlabel="time, s", ylabel="J", xlim=(0, None), ylim=(0, 1), title="importance, three flights each")
    right.set(
        xlabel="time, s",
        ylabel="m/s",
        xlim=(0, TRACE_S),
        ylim=(-0.6, 0.75),
        title="a drone's velocity along x, team of two",
    )
    left.legend(fontsize=7)
    right.legend(fontsize=7, loc="upper right", ncols=2)
    figure.savefig(PICTURE, dpi=110)


def tables(folder: Path, *, maps: bool) -> str:
    flown = {}
    for count in TEAMS:
        for seed in SEEDS:
            for weight in WEIGHTS:
                file = folder / f"team-{count}-{seed}-{weight:g}.json"
                if not file.exists():
                    file.write_text(json.dumps(fly(count, seed, weight)))
                    print(file.name, flush=True)
                flown[count, seed, weight] = json.loads(file.read_text())
    levels = " / ".join(f"{level:g}" for level in LEVELS)
    lines = [
        f"| | s to J < {levels} | path of all, m | flips a second | m/s² | jerk, m/s³ | blur, px | out of time |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for count in TEAMS:
        pair = [[flown[count, seed, weight] for seed in SEEDS] for weight in WEIGHTS]
        for weight, flights in zip(WEIGHTS, pair, strict=True):
            lines.append(row(f"{count} drones, smoothing {weight:g}", flights))
        lines.append(changes(*pair))
    draw(flown)
    if not maps:
        return "\n".join(lines)
    lines += [
        "",
        "| exposure, s | smoothing | s to J < 0.5 | keyframes | sharpness | F visible | F objects |",
        "|---|---|---|---|---|---|---|",
    ]
    for exposure_s in (EXPOSURE_S, 0.0):
        for weight in WEIGHTS:
            file = folder / f"map-{exposure_s:g}-{weight:g}.json"
            if not file.exists():
                file.write_text(json.dumps(fly_with_cameras(folder / file.stem, weight, exposure_s)))
                print(file.name, flush=True)
            told = json.loads(file.read_text())
            lines.append(
                f"| {exposure_s:g} | {weight:g} | {told['sim_time_s']:.0f} | {told['keyframes']}"
                f" | {told['sharpness']:.2f} | {told['f_score_visible']:.3f} | {told['f_score_objects']:.3f} |"
            )
    return "\n".join(lines)


def main(arguments: list[str]) -> None:
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    measured = tables(folder, maps="teams" not in arguments[1:])
    write_measured(PAGE, measured)
    print(measured)


if __name__ == "__main__":
    main(sys.argv[1:])
