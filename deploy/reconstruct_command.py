"""``covrecon reconstruct``: a flight's map made anew from its keyframes, better than there was time for in flight."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Final, Literal, NoReturn

from cyclopts import Parameter

BASE_BYTES: Final = 1.0e9
"""Of the process without its volume: Python, images that are kept, the mesh."""


def reconstruct(
    run: Annotated[Path, Parameter(help="A run's folder, or a recording (.mcap).")] = Path("runs/latest"),
    /,
    *,
    quality: Literal["flown", "fast", "high"] = "high",
    backend: Annotated[str | None, Parameter(show_default=False)] = None,
    settings: Annotated[tuple[str, ...], Parameter(name="--set", negative="", show_default=False)] = (),
    out: Annotated[Path | None, Parameter(show_default=False)] = None,
    figures: Annotated[Path | None, Parameter(show_default=False)] = None,
) -> NoReturn:
    """Make a flight's map anew from the keyframes that it kept, with colour; score it where the scene is known.

    ```
    covrecon reconstruct runs/latest                                   # as well as we can
    covrecon reconstruct runs/latest --set reconstruction.voxel_m=0.015 --out fine.glb
    covrecon reconstruct flight.mcap --quality fast --backend depth
    ```

    Parameters
    ----------
    quality
        "high": finer depth maps and voxels. "fast": as missions fly by default. "flown": the mission's own.
    backend
        As in a mission's reconstruction.backend, instead of the mission's.
    settings
        Changes a setting of the table reconstruction or target; may be given again and again.
    out
        The mesh, PLY or GLB; by default rebuilt.ply in the run's folder, or beside the recording.
    figures
        Also write all figures as JSON.
    """
    from deploy.doctor.machine import GB, VOXEL_BYTES, available_memory, voxels
    from deploy.local import environment
    from ground_station.export.source import open_source
    from ground_station.rebuild.run import rebuilding_mission
    from protocol.errors import ReconstructionError

    mission = rebuilding_mission(open_source(run.resolve()).mission, quality, backend, settings)
    need, free = BASE_BYTES + VOXEL_BYTES * voxels(mission), available_memory()
    if need > free:
        voxel_m = mission.reconstruction.voxel_m
        raise ReconstructionError(
            f"reconstruction.voxel_m {voxel_m:g}: takes about {need / GB:.1f} GB of memory, and {free / GB:.1f} GB are "
            "free; choose a larger voxel, or a smaller target box"
        )
    # -P keeps the current folder from shadowing a package.
    argv = [sys.executable, "-P", "-m", "ground_station.rebuild", str(run.resolve()), "--quality", quality]
    argv += ["--backend", backend] if backend is not None else []
    argv += [part for setting in settings for part in ("--set", setting)]
    argv += ["--out", str(out.resolve())] if out is not None else []
    argv += ["--figures", str(figures.resolve())] if figures is not None else []
    os.execve(sys.executable, argv, environment(os.environ))  # noqa: S606  # the arguments are the caller's own
