"""What is compiled before the mission is what the mission runs: the rehearsal gets as far as a fused map."""

from __future__ import annotations

from typing import Literal

import pytest

from ground_station.m3c2_change import M3C2MeshChange
from ground_station.mesh_change import GridMeshChange, MeshChange
from ground_station.rehearsal import IMAGES, rehearse
from protocol.map_settings import Camera, Feedback, Reconstruction
from protocol.mission import Drone, Mission

DRONES = (Drone(id=1, start=(0.0, 0.0, 2.0, 0.0, 1.3)),)


def test_the_rehearsal_fuses_images() -> None:
    assert rehearse(Mission(drones=DRONES)) > IMAGES / 2


def test_the_rehearsal_does_not_depend_on_the_mission_s_sizes() -> None:
    small = Camera(width_px=160, height_px=90)
    sweep = Reconstruction(sweep_width_px=80, depth_planes=16)
    assert rehearse(Mission(drones=DRONES, camera=small, reconstruction=sweep)) > IMAGES / 2


def test_the_refinement_of_poses_is_rehearsed_too() -> None:
    assert rehearse(Mission(drones=DRONES, reconstruction=Reconstruction(refine_poses=True))) > IMAGES / 2


def test_a_mission_without_a_map_is_rehearsed_too() -> None:
    assert rehearse(Mission(drones=DRONES, reconstruction=Reconstruction(backend="none"))) == IMAGES


@pytest.mark.parametrize(("method", "kind"), [("grid", GridMeshChange), ("m3c2", M3C2MeshChange)])
def test_the_mission_s_kind_of_feedback_is_rehearsed_on_a_mesh(
    monkeypatch: pytest.MonkeyPatch, method: Literal["grid", "m3c2"], kind: type[MeshChange]
) -> None:
    faces = []
    monkeypatch.setattr(kind, "update", lambda _, mesh: faces.append(len(mesh.faces)))
    rehearse(Mission(drones=DRONES, feedback=Feedback(method=method)))
    assert len(faces) == 1
    assert faces[0] > 1000
