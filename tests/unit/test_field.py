"""Every process numbers the cells alike."""

from __future__ import annotations

import math

import numpy as np
import pytest

from protocol.field import VirtualField
from protocol.mission import Target

BOX = Target(
    lower_m=(0.0, -1.0, 2.0),
    upper_m=(1.0, 1.0, 3.5),
    cell_m=0.5,
    yaw_rad=(-1.0, 1.0),
    pitch_rad=(0.5, 1.5),
    cell_rad=0.5,
)


def test_cells_fill_the_box_and_positions_are_their_centres() -> None:
    field = VirtualField.of(BOX)

    assert field.xs.tolist() == [0.25, 0.75]
    assert field.ys.tolist() == [-0.75, -0.25, 0.25, 0.75]
    assert field.zs.tolist() == [2.25, 2.75, 3.25]


def test_positions_run_with_x_slowest_and_z_fastest() -> None:
    field = VirtualField.of(BOX)

    positions = field.positions()

    assert positions.shape == (field.shape[0], 3)
    assert positions[:4].tolist() == [
        [0.25, -0.75, 2.25],
        [0.25, -0.75, 2.75],
        [0.25, -0.75, 3.25],
        [0.25, -0.25, 2.25],
    ]
    for (x, y, z), position in zip(np.ndindex(2, 4, 3), positions, strict=True):
        assert position.tolist() == [field.xs[x], field.ys[y], field.zs[z]]


def test_directions_run_with_yaw_slowest_and_pitch_fastest_and_point_up_to_the_camera() -> None:
    field = VirtualField.of(BOX)

    angles = [(yaw, pitch) for yaw in (-0.75, -0.25, 0.25, 0.75) for pitch in (0.75, 1.25)]

    assert field.directions == pytest.approx(
        np.array([(math.cos(y) * math.cos(p), math.sin(y) * math.cos(p), math.sin(p)) for y, p in angles])
    )
    assert np.linalg.norm(field.directions, axis=1) == pytest.approx(1.0)
    assert field.directions[:, 2].min() > 0


def test_the_number_of_cells_is_positions_times_directions() -> None:
    field = VirtualField.of(BOX)

    assert field.shape == (24, 8)
    assert field.size == 192


@pytest.mark.parametrize(("cell_m", "count"), [(0.3, 7), (0.29, 7), (0.26, 8), (1.4, 1), (50.0, 1)])
def test_a_wished_edge_that_does_not_divide_the_box_gives_the_nearest_that_does(cell_m: float, count: int) -> None:
    field = VirtualField.of(Target(lower_m=(0, 0, 0), upper_m=(2, 2, 2), cell_m=cell_m))

    assert len(field.xs) == count
    assert field.xs[0] == pytest.approx(1 / count)
    assert np.diff(field.xs) == pytest.approx(2 / count)
    assert field.xs[-1] == pytest.approx(2 - 1 / count)


def test_the_same_target_gives_the_same_bytes() -> None:
    one, other = VirtualField.of(Target()), VirtualField.of(Target())

    assert one.positions().tobytes() == other.positions().tobytes()
    assert one.directions.tobytes() == other.directions.tobytes()
