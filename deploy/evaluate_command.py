"""``covrecon evaluate``: how good a map is, against the scene it is of."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Final

from cyclopts import Parameter
from cyclopts.validators import Number

THRESHOLD_M: Final = 0.05
"""As maps of a flight are scored (paper)."""
ANY_MISSION: Final = "[[drones]]\nid = 1\nstart = [0.0, 0.0, 2.0, 0.0, 1.3]\n"
"""All defaults: the paper's box and flight region."""
MISSION_JSON: Final = "mission.json"


def evaluate(
    mesh: Annotated[Path, Parameter(help="A map: PLY, OBJ or GLB, or a run's folder.")],
    truth: Annotated[str, Parameter(help="The scene: a run's folder, its truth_samples.npz, a mesh, or a name.")],
    /,
    *,
    mission: Annotated[Path | None, Parameter(show_default=False)] = None,
    threshold: Annotated[float, Parameter(validator=Number(gt=0))] = THRESHOLD_M,
    picture: Annotated[Path | None, Parameter(show_default=False)] = None,
    ply: Path | None = None,
    json: Annotated[bool, Parameter(negative="", show_default=False)] = False,
) -> int:
    """Say how good a map is: three F-scores beside a bare floor's, distances, and what was found of each furniture.

    A picture shows the map and the scene side by side, each in the colours of its distance to the other.

    ```
    covrecon evaluate runs/latest runs/latest                # a run against its own scene
    covrecon evaluate scan.glb living_room --json            # any mesh against a built-in scene
    covrecon evaluate runs/latest room-7 --ply wrong.ply     # room-<seed>: a random room
    covrecon evaluate map.ply laser.obj --picture error.png  # against a mesh that is taken for true
    ```

    Parameters
    ----------
    mission
        With a scene's name: the mission file whose target box, flight region and camera say what can be seen; that of
        the map's run, or all defaults, without.
    threshold
        Distance in metres within which a point counts.
    picture
        Where the PNG goes; by default error.png in the map's folder.
    ply
        Also write the map in those colours.
    json
        Print all figures as JSON instead of tables.
    """
    from deploy.local import environment

    around = environment(os.environ)
    folder = mesh if mesh.is_dir() else mesh.parent
    picture = picture or folder / "error.png"

    def become(module: str, *arguments: object) -> int:
        # -P keeps the current folder from shadowing a package.
        argv = [sys.executable, "-P", "-m", module, *map(str, arguments)]
        return subprocess.run(argv, env=around, check=False).returncode

    options: list[object] = ["--threshold", threshold, "--picture", picture.resolve()]
    options += ["--ply", ply.resolve()] if ply is not None else []
    options += ["--json"] if json else []
    if Path(truth).exists():
        return become("ground_station.evaluate", mesh.resolve(), Path(truth).resolve(), *options)
    with TemporaryDirectory(prefix="covrecon-truth-") as scratch:
        allows = mission or folder / MISSION_JSON
        if mission is None and not allows.exists():
            allows = Path(scratch) / "any.toml"
            allows.write_text(ANY_MISSION)
        code = become("sim_bridge.scenes", truth, allows.resolve(), scratch)
        return code or become("ground_station.evaluate", mesh.resolve(), scratch, *options)
