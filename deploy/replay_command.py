"""``covrecon replay``: compiles what a replay runs, then becomes its process (`ground_station.replay.__main__`)."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, NoReturn

from cyclopts import Parameter


def replay(
    recording: Annotated[Path, Parameter(help="A recording, or a run's folder with one.")] = Path("runs/latest"),
    /,
    *,
    settings: Annotated[tuple[str, ...], Parameter(name="--set", negative="", show_default=False)] = (),
    out: Path | None = None,
) -> NoReturn:
    """Make a flight's phi and map again from its recording, and say whether they are the same to the last bit.

    With other settings, say what they would have come to: the drones fly as they flew, but the map, its feedback and
    phi are computed anew.

    ```
    covrecon replay runs/latest/recording.mcap
    covrecon replay runs/latest --set feedback.kappa=0.5 --set reconstruction.voxel_m=0.04
    covrecon replay runs/latest --set reconstruction.backend=none --out runs/without-map
    ```

    Parameters
    ----------
    settings
        Changes a setting of the tables feedback, reconstruction, sensing or target; may be given again and again.
    out
        Folder for map, figures and report of the replay. With changed settings there is always one, if need be beside
        the recording.
    """
    from deploy.local import environment
    from ground_station.recording.reader import Recording
    from ground_station.recording.recorder import RECORDING_FILE
    from ground_station.rehearsal import rehearse
    from ground_station.replay.settings import with_settings
    from protocol.importance import compile_kernels

    file = (recording / RECORDING_FILE if recording.is_dir() else recording).resolve()
    flown = Recording.open(file).mission
    mission = with_settings(flown, settings)
    compile_kernels()
    rehearse(mission)
    if out is None and mission != flown:
        out = _free_folder(file)
    # -P keeps the current folder from shadowing a package.
    argv = [sys.executable, "-P", "-m", "ground_station.replay", str(file)]
    argv += [part for setting in settings for part in ("--set", setting)]
    argv += ["--out", str(out.resolve())] if out is not None else []
    os.execve(sys.executable, argv, environment(os.environ))  # noqa: S606  # the arguments are the caller's own


def _free_folder(recording: Path) -> Path:
    """Beside the recording."""
    number = 1
    while (folder := recording.with_name(f"{recording.stem}-replay-{number}")).exists():
        number += 1
    return folder
