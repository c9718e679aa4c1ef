"""phi, opened with numpy and with meshio's reader of VTK files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import meshio
import numpy as np
import pytest

from faults.flown import Flown, a_flight, write_folder
from ground_station.export.importance_files import export_importance, vtk
from ground_station.export.source import Importance, open_source
from protocol.field import VirtualField


@pytest.fixture(scope="module")
def flown() -> Flown:
    return a_flight()


@pytest.fixture(scope="module")
def exported(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("phi")
    export_importance(open_source(write_folder(flown, tmp_path_factory.mktemp("run"))), folder, ("npz", "vtk"))
    return folder


def test_numpy_reads_phi_and_its_lattice(exported: Path, flown: Flown) -> None:
    field = VirtualField.of(flown.mission.target)
    with np.load(exported / "importance.npz") as file:
        np.testing.assert_array_equal(file["phi"], flown.phi)
        for name in ("xs", "ys", "zs", "directions"):
            np.testing.assert_array_equal(file[name], getattr(field, name))


def test_a_reader_of_vtk_has_each_value_at_its_position(exported: Path, flown: Flown) -> None:
    read = meshio.read(exported / "importance.vtk")
    positions = VirtualField.of(flown.mission.target).positions()
    assert len(read.points) == len(positions)
    distances = np.abs(read.points[:, None] - positions[None]).max(axis=2)
    place = distances.argmin(axis=1)
    assert distances.min(axis=1).max() < 1e-9
    assert sorted(place) == list(range(len(positions)))
    data = read.point_data
    assert flown.phi.std() > 0.01
    np.testing.assert_allclose(data["importance"].ravel(), flown.phi.mean(axis=1)[place], rtol=1e-6)
    np.testing.assert_array_equal(data["importance_max"].ravel(), flown.phi.max(axis=1)[place])
    np.testing.assert_array_equal(data["importance_by_direction"], flown.phi[place])


def test_a_field_of_a_single_layer_can_be_written(flown: Flown, tmp_path: Path) -> None:
    target = flown.mission.target.model_copy(update={"upper_m": (3.0, 3.0, 1.0), "cell_m": 1.0})
    field = VirtualField.of(target)
    assert len(field.zs) == 1
    file = tmp_path / "layer.vtk"
    file.write_bytes(b"".join(vtk(Importance(field, np.ones(field.shape, np.float32), "now"), target)))
    assert b"SPACING 1.0 1.0 1.0\n" in file.read_bytes()


def test_one_format_alone_can_be_had(flown: Flown, tmp_path: Path) -> None:
    source = open_source(write_folder(dataclasses.replace(flown), tmp_path / "run"))
    out = tmp_path / "out"
    out.mkdir()
    assert "at the end of the run" in export_importance(source, out, ("vtk",)).content
    assert [file.name for file in out.iterdir()] == ["importance.vtk"]
