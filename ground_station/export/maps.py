"""The map in files: meshes and point clouds (`ground_station.export.meshes` has what is in them)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ground_station.export.georeference import Georeference
from ground_station.export.meshes import MeshFormat, cloud_ply, mesh_file, sample
from ground_station.export.output import Exported, write_georeference
from ground_station.export.source import Source

CLOUD_FILE = "cloud.ply"


def export_mesh(source: Source, folder: Path, formats: Sequence[MeshFormat]) -> Exported:
    """Write mesh.ply, mesh.glb, mesh.obj or some of them.

    Raises CovreconError, and OSError if the disk refuses it.
    """
    mesh = source.mesh()
    for file_format in formats:
        (folder / f"mesh.{file_format}").write_bytes(mesh_file(mesh, file_format))
    write_georeference(folder, Georeference.of(source.mission))
    return Exported(folder, f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles as {', '.join(formats)}")


def export_cloud(source: Source, folder: Path, points: int) -> Exported:
    """Write cloud.ply: ``points`` points spread evenly over the map, with normals and colours.

    Raises CovreconError, and OSError if the disk refuses it.
    """
    (folder / CLOUD_FILE).write_bytes(cloud_ply(sample(source.mesh(), points)))
    write_georeference(folder, Georeference.of(source.mission))
    return Exported(folder, f"{points} points")
