"""Corners are where two edges meet, and each square of the image gives one at most."""

from __future__ import annotations

import numpy as np

from ground_station.reconstruction.corners import find_corners

CELL, MARGIN = 20, 6


def test_the_corners_of_a_bright_square_are_found_and_its_edges_are_not() -> None:
    grey = np.full((90, 160), 40.0, np.float32)
    grey[30:70, 50:110] = 200.0
    found = find_corners(grey, CELL, MARGIN)
    expected = np.array([[49.5, 29.5], [109.5, 29.5], [49.5, 69.5], [109.5, 69.5]])
    away = np.linalg.norm(found[:, None] - expected, axis=2)
    assert (away.min(axis=0) < 4).all()
    assert (away.min(axis=1) < 8).all(), "along an edge nothing can be told apart"


def test_what_has_no_texture_has_no_corners() -> None:
    rng = np.random.default_rng(1)
    noise = 120 + rng.normal(0, 2, (90, 160)).astype(np.float32)
    assert not len(find_corners(noise, CELL, MARGIN))


def test_each_cell_has_one_at_most_and_none_lies_at_the_border() -> None:
    rng = np.random.default_rng(1)
    found = find_corners(rng.uniform(0, 255, (95, 165)).astype(np.float32), CELL, MARGIN)
    assert len(np.unique(found // CELL, axis=0)) == len(found) > 35
    assert (found >= MARGIN).all()
    assert (found[:, 0] < 165 - MARGIN).all()
    assert (found[:, 1] < 95 - MARGIN).all()
