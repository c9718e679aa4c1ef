"""A sweep sees all of its rectangle, and a team sees all of the target, each drone its own part."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.planners.sweep import Footprint, Rectangle, divide, footprint_of, strip_centres, sweep
from protocol.geometry import Floats, camera_rotation
from protocol.map_settings import Camera

FOOTPRINT = Footprint(1.5, 0.84)
lengths = st.floats(0.3, 12.0)
overlaps = st.floats(0.0, 0.9)


def rectangle(width: float, height: float) -> Rectangle:
    return Rectangle((-1.0, 2.0), (-1.0 + width, 2.0 + height))


def test_the_footprint_is_what_the_camera_sees_from_above() -> None:
    """Against the corners' rays; the image's width lies across the heading."""
    camera = Camera()
    intrinsics = camera.intrinsics()
    corner = np.array(
        [(intrinsics.width - intrinsics.cx) / intrinsics.fx, (intrinsics.height - intrinsics.cy) / intrinsics.fy, 1.0]
    )
    ray = camera_rotation(0.0, math.pi / 2) @ corner
    seen = ray[:2] / -ray[2] * 1.7

    footprint = footprint_of(camera, 1.7)

    assert np.abs(seen) == pytest.approx([footprint.length_m / 2, footprint.width_m / 2])


def test_the_papers_camera_sees_a_metre_and_a_half_from_a_metre_above() -> None:
    assert footprint_of(Camera(), 1.0).width_m == pytest.approx(1.5)


@given(length=lengths, width=st.floats(0.2, 3.0), overlap=overlaps)
def test_strips_cover_their_side_with_the_overlap_and_none_is_too_many(
    length: float, width: float, overlap: float
) -> None:
    centres = strip_centres(-1.0, -1.0 + length, width, overlap)

    assert centres[0] - width / 2 <= -1.0 + 1e-9
    assert centres[-1] + width / 2 >= -1.0 + length - 1e-9
    assert (np.diff(centres) <= width * (1 - overlap) + 1e-9).all()
    if len(centres) > 1:
        assert (length - width) / (len(centres) - 1) > 0
    if len(centres) > 2:
        assert (length - width) / (len(centres) - 2) > width * (1 - overlap) - 1e-6, "one less would do"


def seen_from(way: Floats, along: int, footprint: Footprint, points: Floats) -> np.ndarray:
    """Whether each of ``points`` (n, 2) lies in the footprint somewhere along the strips of ``way``."""
    across, seen = 1 - along, np.zeros(len(points), bool)
    for first, last in zip(way[::2], way[1::2], strict=True):
        low, high = sorted([first[along], last[along]])
        beside = np.abs(points[:, across] - first[across]) <= footprint.width_m / 2 + 1e-9
        ahead = points[:, along] - high <= footprint.length_m / 2 + 1e-9
        behind = low - points[:, along] <= footprint.length_m / 2 + 1e-9
        seen |= beside & ahead & behind
    return seen


@given(width=lengths, height=lengths, overlap=overlaps, along=st.sampled_from([0, 1]), seed=st.integers(0, 999))
def test_a_sweep_sees_the_whole_rectangle_strip_by_strip(
    width: float, height: float, overlap: float, along: int, seed: int
) -> None:
    sector, start = rectangle(width, height), np.random.default_rng(seed).uniform(-5, 15, 2)
    way = sweep(sector, along, FOOTPRINT, overlap, start)
    grid = np.stack(
        np.meshgrid(*[np.linspace(sector.low[k], sector.high[k], 25) for k in (0, 1)], indexing="ij"), axis=-1
    )

    assert seen_from(way, along, FOOTPRINT, grid.reshape(-1, 2)).all()
    assert (way >= np.array(sector.low) - 1e-9).all()
    assert (way <= np.array(sector.high) + 1e-9).all()
    np.testing.assert_array_equal(way[::2, 1 - along], way[1::2, 1 - along], "strips are straight")
    np.testing.assert_array_equal(way[1:-1:2, along], way[2::2, along], "from a strip's end straight to the next")


@pytest.mark.parametrize("start", [(-9.0, -9.0), (9.0, -9.0), (-9.0, 9.0), (9.0, 9.0)])
@pytest.mark.parametrize("along", [0, 1])
def test_a_sweep_begins_at_the_nearest_corner(start: tuple[float, float], along: int) -> None:
    way = sweep(Rectangle((-3.0, -3.0), (3.0, 3.0)), along, FOOTPRINT, 0.6, np.array(start))

    assert np.sign(way[0]).tolist() == np.sign(start).tolist()
    assert math.dist(way[0], start) == pytest.approx(min(math.dist(place, start) for place in way))


@given(count=st.integers(1, 16), width=st.floats(2, 12), height=st.floats(2, 12), seed=st.integers(0, 999))
def test_a_team_divides_the_area_into_equal_parts_without_gap_or_overlap(
    count: int, width: float, height: float, seed: int
) -> None:
    area, rng = rectangle(width, height), np.random.default_rng(seed)
    starts = {k + 1: (float(x), float(y)) for k, (x, y) in enumerate(rng.uniform(-4, 4, (count, 2)))}

    parts = divide(area, starts)

    assert sorted(parts) == sorted(starts)
    sides = np.array([np.subtract(part.high, part.low) for part in parts.values()])
    assert sides.prod(axis=1) == pytest.approx(width * height / count)
    points = rng.uniform(area.low, area.high, (500, 2))
    inside = [((points >= part.low) & (points < part.high)).all(axis=1) for part in parts.values()]
    assert (np.sum(inside, axis=0) == 1).all()
    shape = max(width, height) / min(width, height)
    assert (sides.max(axis=1) / sides.min(axis=1)).max() <= max(3.0, shape) + 1e-9, "no share of a cut is below 1/3"
    assert divide(area, dict(reversed(starts.items()))) == parts, "whatever order the drones are named in"


def test_drones_get_the_parts_on_their_own_side() -> None:
    area = Rectangle((-3.0, -3.0), (3.0, 3.0))
    starts = {1: (2.0, 2.0), 2: (-2.0, 2.0), 3: (2.0, -2.0), 4: (-2.0, -2.0)}

    for drone, part in divide(area, starts).items():
        assert part.low[0] <= starts[drone][0] <= part.high[0]
        assert part.low[1] <= starts[drone][1] <= part.high[1]


def test_four_drones_on_one_line_still_get_a_quarter_each() -> None:
    parts = divide(Rectangle((-3.0, -3.0), (3.0, 3.0)), {k: (1.1 * k, 1.0) for k in range(4)})

    assert {(part.low, part.high) for part in parts.values()} == {
        ((-3.0, -3.0), (0.0, 0.0)),
        ((-3.0, 0.0), (0.0, 3.0)),
        ((0.0, -3.0), (3.0, 0.0)),
        ((0.0, 0.0), (3.0, 3.0)),
    }
