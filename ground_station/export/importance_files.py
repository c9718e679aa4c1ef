"""phi as arrays for numpy (NPZ) and as an image for ParaView and the like (VTK)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from ground_station.export.georeference import Georeference
from ground_station.export.output import Exported, write_georeference
from ground_station.export.source import Importance, Source
from protocol.mission import Target

ImportanceFormat: TypeAlias = Literal["npz", "vtk"]

NPZ_FILE, VTK_FILE = "importance.npz", "importance.vtk"


def export_importance(source: Source, folder: Path, formats: Sequence[ImportanceFormat]) -> Exported:
    """Write importance.npz, importance.vtk or both.

    Raises CovreconError, and OSError if the disk refuses it.
    """
    importance = source.importance()
    if "npz" in formats:
        write_npz(importance, folder / NPZ_FILE)
    if "vtk" in formats:
        with (folder / VTK_FILE).open("wb") as file:
            file.writelines(vtk(importance, source.mission.target))
    write_georeference(folder, Georeference.of(source.mission))
    positions, directions = importance.phi.shape
    return Exported(folder, f"phi {importance.moment}: {positions} positions, {directions} directions")


def write_npz(importance: Importance, file: Path) -> None:
    """``phi`` float32 (positions, directions), x slowest and z fastest; its lattice ``xs``, ``ys``, ``zs`` in metres;
    ``directions`` (directions, 3) unit vectors from the cell towards the camera."""
    field = importance.field
    np.savez_compressed(file, phi=importance.phi, xs=field.xs, ys=field.ys, zs=field.zs, directions=field.directions)


def vtk(importance: Importance, target: Target) -> Iterator[bytes]:
    """Legacy VTK file, binary: structured points at the cells' positions, in the world frame, metres.

    Arrays: ``importance``, the mean over all directions, whose mean is J of eq. (3); ``importance_max``; and
    ``importance_by_direction`` with a component each.
    """
    axes = (importance.field.xs, importance.field.ys, importance.field.zs)
    counts = [len(axis) for axis in axes]
    lengths = [high - low for low, high in zip(target.lower_m, target.upper_m, strict=True)]
    spacing = [length / count for length, count in zip(lengths, counts, strict=True)]
    # VTK has x fastest, and all numbers with the most significant byte first.
    points, directions = importance.phi.shape
    phi = importance.phi.reshape(*counts, directions).transpose(2, 1, 0, 3)
    yield (
        "# vtk DataFile Version 3.0\n"
        f"importance phi {importance.moment}\n"
        "BINARY\n"
        "DATASET STRUCTURED_POINTS\n"
        f"DIMENSIONS {_numbers(counts)}\n"
        f"ORIGIN {_numbers([float(axis[0]) for axis in axes])}\n"
        f"SPACING {_numbers(spacing)}\n"
        f"POINT_DATA {points}\n"
        "SCALARS importance float 1\n"
        "LOOKUP_TABLE default\n"
    ).encode("ascii")
    yield phi.mean(axis=3, dtype=np.float64).astype(">f4").tobytes()
    yield f"\nFIELD FieldData 2\nimportance_max 1 {points} float\n".encode("ascii")
    yield phi.max(axis=3).astype(">f4").tobytes()
    yield f"\nimportance_by_direction {directions} {points} float\n".encode("ascii")
    for layer in phi:  # one by one: phi may be large
        yield layer.astype(">f4").tobytes()
    yield b"\n"


def _numbers(values: list[int] | list[float]) -> str:
    return " ".join(map(repr, values))
