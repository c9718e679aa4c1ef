"""The curve of a training as a picture."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ground_station.reconstruction.learned.training.trainer import Point

SIZE_INCH = (9.0, 3.2)
DOTS_PER_INCH = 110


def draw_curve(points: Sequence[Point]) -> bytes:
    """PNG: loss in training and held out, and the held-out errors that people can picture."""
    from matplotlib.figure import Figure

    figure = Figure(SIZE_INCH, layout="constrained")
    loss, error, occupancy = figure.subplots(1, 3)
    steps = [point.step for point in points]
    loss.plot(steps, [point.loss for point in points], label="learnt from")
    loss.plot(steps, [point.held_out_loss for point in points], label="held out")
    loss.legend()
    loss.set_title("loss")
    error.plot(steps, [point.held_out_mm for point in points])
    error.set_title("held out: distance error near surfaces [mm]")
    occupancy.plot(steps, [point.held_out_occupancy for point in points])
    occupancy.set_title("held out: F of occupancy")
    for axes in (loss, error, occupancy):
        axes.set_xlabel("step")
        axes.grid(alpha=0.3)
        axes.title.set_fontsize(9)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=DOTS_PER_INCH)
    return picture.getvalue()
