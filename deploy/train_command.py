"""``covrecon train``: new weights for the learned reconstructor, from random rooms that are furnished for it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from protocol.errors import ProcessError, TrainingError

AtLeastOne = Number(gte=1)


def train(
    *,
    config: Path | None = None,
    out: Path = Path("training"),
    steps: Annotated[int | None, Parameter(validator=AtLeastOne)] = None,
    minutes: Annotated[float | None, Parameter(validator=Number(gt=0))] = None,
    resume: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    jobs: Annotated[int | None, Parameter(validator=AtLeastOne)] = None,
) -> int:
    """Teach the network of the backend "learned"; its weights, curve and checkpoint come to lie in a folder.

    First random rooms are furnished and photographed, then the network learns from them on one thread. It takes the
    extra "learned". After an interrupt, `--resume` goes on: with the same settings the weights are the same as without.

    ```
    covrecon train --minutes 40                           # of learning, after some minutes of furnishing
    covrecon train --steps 10000 --out training/long       # as long as it takes
    covrecon train --steps 10000 --out training/long --resume
    ```

    A mission flies with them by `reconstruction.backend = "learned"` and `reconstruction.learned.weights = FILE`.

    Parameters
    ----------
    config
        TOML file of settings that differ from the default ones: rooms, seed, window and the like (docs/learned.md).
    out
        The training's folder.
    steps
        Fragments that are learnt from, instead of what the settings say.
    minutes
        As many steps as this allows; how many is told on the way.
    resume
        Go on with the training in the folder.
    jobs
        Rooms that are furnished at a time; all cores without.
    """
    from deploy.local import environment
    from ground_station.reconstruction.learned.requirements import require_torch
    from ground_station.reconstruction.learned.training.folder import begin, missing_rooms
    from ground_station.reconstruction.learned.training.settings import TrainingSettings, load_settings

    if steps is not None and minutes is not None:
        raise TrainingError("--steps and --minutes: give one of them")
    require_torch()
    settings = load_settings(config) if config is not None else TrainingSettings()
    begin(out, settings, resume=resume)
    _furnish(out, missing_rooms(out, settings), jobs)
    argv = [sys.executable, "-P", "-m", "ground_station.reconstruction.learned.training", str(out.resolve())]
    argv += ["--steps", str(steps)] if steps is not None else []
    argv += ["--minutes", str(minutes)] if minutes is not None else []
    argv += ["--resume"] if resume else []
    return subprocess.run(argv, env=environment(os.environ), check=False).returncode


def _furnish(out: Path, seeds: Sequence[int], jobs: int | None) -> None:
    """Have processes of the simulator's write the rooms that are missing. Raises `ProcessError` if one fails."""
    from rich.console import Console
    from rich.progress import Progress

    from deploy.bench.plan import cores
    from ground_station.reconstruction.learned.training.folder import ROOMS_FOLDER

    if not seeds:
        return
    console = Console(highlight=False)
    count = min(len(seeds), jobs or cores())
    with Progress(console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task("furnishing rooms", total=len(seeds))
        if not console.is_terminal:
            console.print(f"furnishing {len(seeds)} rooms")
        with ThreadPoolExecutor(count) as pool:
            done = [
                pool.submit(_write_rooms, out / ROOMS_FOLDER, seeds[first::count], lambda: progress.advance(bar))
                for first in range(count)
            ]
            for each in done:
                each.result()


def _write_rooms(folder: Path, seeds: Sequence[int], advance: Callable[[], None]) -> None:
    from deploy.local import environment
    from ground_station.reconstruction.learned.fragment import FINE_M, REACH_M

    argv = [sys.executable, "-P", "-m", "sim_bridge.training_rooms", str(folder.resolve())]
    argv += ["--voxel", str(FINE_M), "--reach", str(REACH_M), "--seeds", *map(str, seeds)]
    with subprocess.Popen(argv, env=environment(os.environ), stdout=subprocess.PIPE, text=True) as process:
        for _ in process.stdout or ():
            advance()
    if process.returncode:
        raise ProcessError(f"the rooms could not be furnished: exit code {process.returncode}")
