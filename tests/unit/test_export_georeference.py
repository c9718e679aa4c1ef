"""Where the world lies on Earth: by PROJ's own projection, and as the vehicles have it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest

from agents.vehicles.px4 import frames
from agents.vehicles.px4.frames import GlobalPosition, offset
from ground_station.export.georeference import EARTH_RADIUS_M, Georeference
from ground_station.export.output import write_georeference

ORIGINS = [(47.397742, 8.545594, 488.0), (-33.9, 18.4, 0.0), (0.0, 179.9999, 10.0), (69.6, -18.95, -3.0)]
NANODEGREE = 1e-9
SPHERE_ERROR = 0.007
"""PX4's sphere against the ellipsoid: radii of curvature differ by up to 0.6 %."""


def places() -> np.ndarray:
    """(n, 3) metres, up to some kilometres away."""
    drawn = np.random.default_rng(1).uniform(-5000, 5000, (50, 3))
    return np.vstack([np.zeros(3), drawn, drawn / 1e4, [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]])


@pytest.mark.parametrize("origin", ORIGINS)
def test_proj_agrees_to_a_nanodegree_with_the_projection_that_is_told(
    origin: tuple[float, float, float], tmp_path: Path
) -> None:
    write_georeference(tmp_path, Georeference(*origin))
    told = json.loads((tmp_path / "georeference.json").read_text())
    transformer = pyproj.Transformer.from_crs(told["proj"], "EPSG:4326", always_xy=True)
    longitude, latitude = transformer.transform(*places()[:, :2].T)
    ours = Georeference(*origin).geodetic(places())
    np.testing.assert_allclose(ours[:, 0], latitude, atol=NANODEGREE)
    turned = (ours[:, 1] - longitude + 180) % 360 - 180
    np.testing.assert_allclose(turned, 0, atol=NANODEGREE)
    np.testing.assert_allclose(ours[:, 2], told["altitude_amsl_m"] + places()[:, 2])


@pytest.mark.parametrize("origin", ORIGINS)
def test_it_undoes_what_the_vehicles_do_to_a_micrometre(origin: tuple[float, float, float]) -> None:
    assert EARTH_RADIUS_M == frames.EARTH_RADIUS_M
    for place, geodetic in zip(places(), Georeference(*origin).geodetic(places()), strict=True):
        back = offset(GlobalPosition(*origin), GlobalPosition(*geodetic.tolist()))
        np.testing.assert_allclose(back, place, atol=1e-6)


@pytest.mark.parametrize("origin", ORIGINS)
def test_on_the_real_ellipsoid_places_lie_where_they_should(origin: tuple[float, float, float]) -> None:
    """East is east and north is north, and a distance is right to what a sphere can be."""
    earth = pyproj.Geod(ellps="WGS84")
    for place, (latitude, longitude, _) in zip(places(), Georeference(*origin).geodetic(places()), strict=True):
        azimuth, _, distance = earth.inv(origin[1], origin[0], longitude, latitude)
        east, north = distance * np.sin(np.radians(azimuth)), distance * np.cos(np.radians(azimuth))
        assert np.hypot(east - place[0], north - place[1]) <= SPHERE_ERROR * np.hypot(*place[:2]) + 1e-6


def test_longitudes_stay_within_half_a_turn() -> None:
    longitudes = Georeference(0.0, 179.9999, 0.0).geodetic(np.array([[-100.0, 0, 0], [100.0, 0, 0]]))[:, 1]
    assert longitudes[0] > 179
    assert longitudes[1] < -179


def test_what_is_not_known_has_no_place() -> None:
    assert np.isnan(Georeference(*ORIGINS[0]).geodetic(np.full((1, 3), np.nan))).all()
