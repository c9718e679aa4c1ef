"""Contacts of simulated vehicles with the scene: exact, once each, and told to whoever judges the flight."""

from __future__ import annotations

import numpy as np
import pytest

from faults.seen_room import room_mission
from protocol.geometry import Floats
from sim_bridge.contacts import Contacts

MISSION = room_mission(simulation={"vehicle_radius_m": 0.2})
WALL = np.array([[[0.0, -1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]]], np.float32)
"""One triangle in the plane x = 0."""
MIDDLE = np.array([0.0, 0.0, 1.5])


def fly(contacts: Contacts, *xs: float) -> int:
    for x in xs:
        contacts.note({1: np.array([x, 0.0, 0.5, 0.0, 1.3])})
    return contacts.counts[1]


def test_a_contact_counts_when_it_begins() -> None:
    contacts = Contacts(MISSION, WALL)
    assert fly(contacts, 1.0, 0.21, 0.201) == 0
    assert fly(contacts, 0.19, 0.1, 0.0, -0.15) == 1
    assert fly(contacts, -0.3, -0.1) == 2
    assert contacts.counts == {1: 2, 2: 0}


def test_beside_a_triangle_nothing_is_touched() -> None:
    contacts = Contacts(MISSION, WALL)
    contacts.note({1: np.array([0.0, 1.0 + 0.19, 0.0]), 2: np.array([0.0, 1.0 + 0.21, 0.0])})
    assert contacts.counts == {1: 1, 2: 0}


def test_far_from_the_region_and_without_a_scene_nothing_happens() -> None:
    contacts = Contacts(MISSION, WALL)
    contacts.note({1: np.array([90.0, -80.0, 70.0])})
    empty = Contacts(MISSION, np.empty((0, 3, 3), np.float32))
    empty.note({1: np.zeros(3)})
    assert contacts.counts == empty.counts == {1: 0, 2: 0}


def sampled_distance(triangles: Floats, place: Floats) -> float:
    """From points all over the triangles: never less than the truth, and little more."""
    weights = np.array([(a, b, 1 - a - b) for a in np.linspace(0, 1, 41) for b in np.linspace(0, 1 - a, 41)])
    points = np.einsum("wc,tcx->twx", weights, triangles).reshape(-1, 3)
    return float(np.linalg.norm(points - place, axis=1).min())


@pytest.mark.parametrize("seed", range(4))
def test_contacts_of_random_triangles_are_those_of_points_on_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-1.5, 1.5, (25, 1, 3)) + MIDDLE
    triangles = (centres + rng.uniform(-0.5, 0.5, (25, 3, 3))).astype(np.float32)
    judged = 0
    for place in rng.uniform(-1.5, 1.5, (40, 3)) + MIDDLE:
        contacts = Contacts(MISSION, triangles)
        contacts.note({1: place})
        distance = sampled_distance(triangles.astype(float), place)
        if abs(distance - 0.2) > 0.02:
            judged += 1
            assert contacts.counts[1] == (distance < 0.2)
    assert judged > 30
