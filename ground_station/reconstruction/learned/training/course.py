"""A whole training: rooms into memory, steps with a bar, the curve as table and picture, and the weights at the end."""

from __future__ import annotations

import csv
import io
import time
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ground_station.durable import replace_file
from ground_station.reconstruction.learned.training.curve import draw_curve
from ground_station.reconstruction.learned.training.folder import (
    CHECKPOINT_FILE,
    CURVE_FILE,
    PICTURE_FILE,
    WEIGHTS_FILE,
    room_path,
)
from ground_station.reconstruction.learned.training.lessons import load_room
from ground_station.reconstruction.learned.training.settings import TrainingSettings
from ground_station.reconstruction.learned.training.trainer import Point, Trainer, load_checkpoint, save_checkpoint
from ground_station.reconstruction.learned.weights import save_network


def run_course(
    settings: TrainingSettings,
    folder: Path,
    *,
    steps: int | None = None,
    minutes: float | None = None,
    resume: bool = False,
) -> None:
    """Learn until ``steps`` are done, or for about ``minutes``; ``resume``: from the checkpoint in ``folder``, if any.

    With minutes, the number of steps is settled when the rate's plateau is over, from the pace until then. So it then
    is a training of that many steps, which anybody can repeat. Raises `TrainingError`.
    """
    console = Console(highlight=False)
    rooms, held_out = (
        [load_room(room_path(folder, seed)) for seed in seeds]
        for seeds in (settings.room_seeds, settings.held_out_seeds)
    )
    trainer = Trainer(settings, rooms, held_out)
    checkpoint = folder / CHECKPOINT_FILE
    if resume and checkpoint.exists():
        load_checkpoint(checkpoint, trainer)
        console.print(f"goes on after step {trainer.step}")
    until = None if minutes is None else time.monotonic() + 60 * minutes
    plateau_s = 60 * (1 - settings.decay_share) * (minutes or 0)
    total = steps or settings.steps
    began_s, began_at = time.monotonic(), trainer.step
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task("learning", total=None if until else total, completed=trainer.step)
        while until is not None or trainer.step < total:
            # The plateau does not hang on the number of steps; any that is far away will do until it is known.
            trainer.learn(total if until is None else 2 * (trainer.step + settings.warm_up) * 10)
            progress.update(bar, completed=trainer.step)
            if until is not None and time.monotonic() - began_s >= plateau_s:
                done = trainer.step - began_at
                total = trainer.step + round(done * settings.decay_share / max(1e-9, 1 - settings.decay_share))
                until = None
                progress.update(bar, total=total)
                console.print(f"the training takes {total} steps")
            if trainer.step % settings.measured_every == 0 or trainer.step == total:
                _report(folder, trainer, console)
    save_network(folder / WEIGHTS_FILE, trainer.network)
    console.print(f"weights: {folder / WEIGHTS_FILE}")


def _report(folder: Path, trainer: Trainer, console: Console) -> None:
    point = trainer.measure()
    save_checkpoint(folder / CHECKPOINT_FILE, trainer)
    table = io.StringIO()
    writer = csv.writer(table)
    writer.writerow(Point.__slots__)
    writer.writerows([getattr(each, name) for name in Point.__slots__] for each in trainer.curve)
    replace_file(folder / CURVE_FILE, [table.getvalue().encode()])
    replace_file(folder / PICTURE_FILE, [draw_curve(trainer.curve)])
    console.print(
        f"step {point.step}: loss {point.loss:.3f}, held out {point.held_out_loss:.3f},"
        f" {point.held_out_mm:.1f} mm, occupancy F {point.held_out_occupancy:.3f}"
    )
