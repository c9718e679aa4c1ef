"""Whether the files and devices that a mission names are there: its scene, its cameras, its serial lines."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

from deploy.doctor.finding import Finding
from protocol.mission import Mission


def check_inputs(mission: Mission) -> Iterator[Finding]:
    """One finding for each; none of what is reached over a network."""
    scene = Path(mission.simulation.scene)
    if scene.is_absolute():  # as a mission file's paths are once it is loaded; a built-in scene has a bare name
        yield _check("scene", scene, "correct simulation.scene, which is relative to the mission file")
    for drone in mission.drones:
        if drone.camera and "://" not in drone.camera:
            advice = f"connect it, or correct the camera of drone {drone.id}"
            yield _check(f"camera of drone {drone.id}", Path(drone.camera), advice)
        serial = re.match(r"serial://([^:]+)", mission.vehicle_url(drone))
        if serial and mission.vehicles.kind == "px4":
            advice = f"connect it, or correct the url of drone {drone.id}"
            yield _check(f"PX4 of drone {drone.id}", Path(serial[1]), advice)


def _check(subject: str, path: Path, advice: str) -> Finding:
    if not path.exists():
        return Finding(subject, "fail", f"{path} is not there", advice)
    if not os.access(path, os.R_OK):
        groups = "join the group that owns it: sudo usermod -aG dialout,video $USER, then log in again"
        return Finding(subject, "fail", f"{path} may not be read by this user", groups)
    return Finding(subject, "ok", f"{path} is there")
