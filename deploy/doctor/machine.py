"""Processor, memory and disk, against what the mission will want of them."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from deploy.doctor.finding import Finding
from protocol.guard import ROOT
from protocol.mission import Mission

GB = 1e9
CORES_MIN = 2
"""Ground station and simulator compute at the same time; with one core real time is not kept."""

# What the demonstration mission was seen to take, rounded up.
BASE_BYTES, DRONE_BYTES = 1.5 * GB, 0.25 * GB
"""Memory of launcher, router, simulator, console and ground station; and of each agent."""
VOXEL_BYTES = 12
"""Of the dense volume that the map lives in."""
JPEG_BYTES_PER_PIXEL = 0.5
"""At quality 90."""
MESH_BYTES_PER_COLUMN = 100
"""Of a recorded mesh, for each column of voxels over the target's floor."""
STATE_BYTES = 2000
"""Recorded for each drone and tick."""
SPARE = 2.0
"""The disk should hold so many such missions, or there is a warning."""


def voxels(mission: Mission) -> float:
    """How many the map's volume has."""
    box = mission.target
    return math.prod(high - low for low, high in zip(box.lower_m, box.upper_m, strict=True)) / (
        mission.reconstruction.voxel_m**3
    )


def memory_need(mission: Mission) -> float:
    """Bytes that the whole mission takes on one computer, about."""
    return BASE_BYTES + DRONE_BYTES * len(mission.drones) + VOXEL_BYTES * voxels(mission)


def disk_need(mission: Mission) -> float:
    """Bytes that the run's folder grows to if the mission flies for its whole duration, at most about."""
    camera, flight, box = mission.camera, mission.flight, mission.target
    turning_hz = max(flight.velocity_limits[3:]) / camera.keyframe_angle_rad
    rate_hz = flight.speed_max_mps / camera.keyframe_baseline_m + turning_hz
    images = rate_hz * JPEG_BYTES_PER_PIXEL * camera.width_px * camera.height_px if mission.simulation.scene else 0.0
    drones_seconds = len(mission.drones) * mission.duration_s
    volume = VOXEL_BYTES * voxels(mission)
    kept = images * drones_seconds + volume  # checkpoints are compressed: two take less than the volume once
    if not mission.recording.enabled:
        return kept
    floor = (box.upper_m[0] - box.lower_m[0]) * (box.upper_m[1] - box.lower_m[1]) / mission.reconstruction.voxel_m**2
    meshes = mission.duration_s / mission.recording.mesh_period_s * MESH_BYTES_PER_COLUMN * floor
    states = STATE_BYTES * mission.controller.rate_hz * drones_seconds
    return kept + images * drones_seconds + meshes + states


def check_machine(mission: Mission, out: Path) -> Iterator[Finding]:
    """``out``: where run folders are made."""
    yield check_processor(len(os.sched_getaffinity(0)), _quota_cores(), os.getloadavg()[0])
    yield from check_governor()
    yield check_compiled()
    yield check_memory(memory_need(mission), available_memory())
    yield check_disk(disk_need(mission), out)


def check_processor(cores: int, quota: float, load: float) -> Finding:
    """``quota``: cores' worth of time that we may have; ``load``: how many processes want a core, a minute's mean."""
    usable = min(float(cores), quota)
    text = f"{cores} cores{f', {quota:g} cores worth of time' if quota < cores else ''}, load {load:.1f}"
    if usable < CORES_MIN:
        advice = "fly with --speed max, which waits for a slow computer, or give it more cores"
        return Finding("processor", "warn", f"{text}: too little for real time", advice)
    if load > usable:
        return Finding("processor", "warn", f"{text}: others are using it", "end what else runs, or expect lateness")
    return Finding("processor", "ok", text)


def _quota_cores(path: Path = Path("/sys/fs/cgroup/cpu.max")) -> float:
    """What a container's limit leaves; infinity without one."""
    try:
        quota, period = path.read_text().split()
    except OSError:
        return math.inf
    return math.inf if quota == "max" else int(quota) / int(period)


def check_governor(folder: Path = Path("/sys/devices/system/cpu/cpufreq")) -> Iterator[Finding]:
    """Nothing where the frequency is not the system's to choose, as in a virtual machine."""
    slow = [
        policy.name
        for policy in sorted(folder.glob("policy*"))
        if _read(policy / "scaling_governor") == "powersave" and "pstate" not in _read(policy / "scaling_driver")
    ]  # the governor "powersave" of intel_pstate and amd-pstate does raise the frequency under load
    if slow:
        advice = "for a flight in real time: sudo cpupower frequency-set -g performance"
        yield Finding("frequency", "warn", f"held at the lowest by the governor powersave ({', '.join(slow)})", advice)


def _read(path: Path) -> str:
    return path.read_text().strip() if path.is_file() else ""


def check_compiled() -> Finding:
    """Where numba keeps what it compiled: without a place, every process compiles for a minute first."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    home = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    candidates = [Path(chosen)] if chosen else [ROOT / "protocol" / "__pycache__", Path(home) / "numba"]
    for folder in candidates:
        if is_writable(folder):
            return Finding("compiled code", "ok", f"kept in {folder}")
    return Finding(
        "compiled code",
        "warn",
        f"cannot be kept in {' or '.join(map(str, candidates))}: every process compiles anew, a minute each",
        "set NUMBA_CACHE_DIR to a folder that you may write to",
    )


def is_writable(folder: Path) -> bool:
    """Whether files can be made in ``folder``, which need not be there yet."""
    existing = nearest_folder(folder)
    try:
        with tempfile.TemporaryFile(dir=existing):
            return True
    except OSError:
        return False


def nearest_folder(path: Path) -> Path:
    """``path``, or the folder above it in which it would be made."""
    path = path.absolute()
    return next((folder for folder in (path, *path.parents) if folder.exists()), path)


def available_memory(meminfo: Path = Path("/proc/meminfo"), cgroup: Path = Path("/sys/fs/cgroup")) -> float:
    """Bytes that can be had without swapping, also within a container."""
    fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
    free = float(fields["MemAvailable"].split()[0]) * 1024
    limit, used = _read(cgroup / "memory.max"), _read(cgroup / "memory.current")
    return min(free, float(limit) - float(used)) if limit.isdigit() and used.isdigit() else free


def check_memory(need: float, available: float) -> Finding:
    text = f"{available / GB:.1f} GB free, the mission takes about {need / GB:.1f} GB"
    if available < need:
        advice = "end other programs, fly fewer drones, or raise reconstruction.voxel_m"
        return Finding("memory", "fail", text, advice)
    return Finding("memory", "ok", text)


def check_disk(need: float, out: Path) -> Finding:
    if not is_writable(out):
        return Finding("disk", "fail", f"{out} cannot be written to", "choose another folder: covrecon run --out")
    free = float(shutil.disk_usage(nearest_folder(out)).free)
    text = f"{free / GB:.1f} GB free for {out}, the mission may take {need / GB:.1f} GB"
    advice = "delete old runs, choose another disk by --out, or set recording.enabled = false"
    if free < need:
        return Finding("disk", "fail", text, advice)
    return Finding("disk", "warn" if free < SPARE * need else "ok", text, advice if free < SPARE * need else "")
