"""Measured depth that is wrong is refused with the reason, and kept out of the map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from faults.boxes import fly_over, mission, share_right
from ground_station.reconstruction.backends import make_reconstructor
from ground_station.reconstruction.reconstructor import Keyframe, Mesh

FLIGHT = fly_over()


def scaled(keyframe: Keyframe, factor: float) -> Keyframe:
    assert keyframe.depth is not None
    return replace(keyframe, depth=keyframe.depth * np.float32(factor))


def flown(keyframes: Sequence[Keyframe]) -> tuple[Counter[str], Mesh]:
    """How many keyframes were fused, and refused for each reason."""
    reconstructor = make_reconstructor(mission("depth"))
    outcomes = [outcome for keyframe in keyframes for outcome in reconstructor.add([keyframe])]
    outcomes += reconstructor.flush()
    counts = Counter(outcome.reason or outcome.state for outcome in outcomes)
    del counts["waiting"]
    refused = sum(reconstructor.statistics().refused.values())
    assert refused == counts.total() - counts["fused"]
    return counts, reconstructor.mesh()


def test_true_depth_is_all_fused() -> None:
    counts, mesh = flown(FLIGHT)
    assert counts == {"fused": len(FLIGHT)}
    assert share_right(mesh) > 0.99


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda one: replace(one, depth=None), "no_depth"),
        (lambda one: replace(one, depth=np.zeros_like(one.depth)), "no_depth"),
        (lambda one: scaled(one, 0.001), "no_depth"),
        (lambda one: scaled(one, 1000.0), "off_target"),
        (lambda one: scaled(one, 2.0), "off_target"),
        (lambda one: scaled(one, 1.3), "wrong_scale"),
        (lambda one: scaled(one, 0.8), "wrong_scale"),
        (lambda one: scaled(one, 0.5), "wrong_scale"),
    ],
    ids=["none", "unknown", "as kilometres", "as millimetres", "x 2", "x 1.3", "x 0.8", "x 0.5"],
)
def test_a_camera_that_always_measures_wrong_maps_nothing(change: Callable[[Keyframe], Keyframe], reason: str) -> None:
    counts, mesh = flown([change(one) for one in FLIGHT])
    assert counts == {reason: len(FLIGHT)}
    assert mesh.faces.size == 0


@pytest.mark.parametrize("factor", [0.3048, 0.6, 1.2, 3.28])
def test_one_drone_whose_depths_differ_from_the_others_by_a_factor_is_kept_out(factor: float) -> None:
    counts, mesh = flown([scaled(one, factor) if one.drone == 2 else one for one in FLIGHT])
    assert counts["fused"] >= len(FLIGHT) / 2 - 1
    assert counts["wrong_scale"] + counts["off_target"] >= len(FLIGHT) / 2
    assert share_right(mesh) > 0.97


def test_a_frame_that_shows_something_else_is_kept_out() -> None:
    swapped = list(FLIGHT)
    swapped[8] = replace(FLIGHT[8], depth=FLIGHT[2].depth)
    counts, mesh = flown(swapped)
    assert counts["no_depth"] + counts["wrong_scale"] == 1
    assert share_right(mesh) > 0.99


def test_noise_of_a_depth_camera_is_averaged_out() -> None:
    random = np.random.default_rng(4)

    def noisy(one: Keyframe) -> Keyframe:
        assert one.depth is not None
        noise = random.standard_normal(one.depth.shape) * (0.002 + 0.003 * one.depth**2)
        return replace(one, depth=(one.depth + noise).astype(np.float32))

    counts, mesh = flown([noisy(one) for one in FLIGHT])
    assert counts == {"fused": len(FLIGHT)}
    assert share_right(mesh) > 0.97


def test_a_camera_in_the_dark_maps_by_its_depth() -> None:
    counts, mesh = flown([replace(one, image=np.zeros_like(one.image)) for one in FLIGHT])
    assert counts == {"fused": len(FLIGHT)}
    assert share_right(mesh) > 0.99
