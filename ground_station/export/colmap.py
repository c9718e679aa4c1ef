"""COLMAP's text model: cameras, images and points as structure from motion would have found them.

In the layout that programs which take COLMAP's output expect: ``images/`` and ``sparse/0/``. The points have no tracks,
as they come from the map. With a georeferenced mission ``geo.txt`` has each image's place for ``colmap model_aligner
--ref_images_path geo.txt --ref_is_gps 1``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ground_station.export.georeference import Georeference
from ground_station.export.output import Exported, write_georeference
from ground_station.export.source import Source
from ground_station.export.sparse import sparse_points
from ground_station.export.views import View, write_images
from protocol.geometry import Intrinsics

MODEL_FOLDER = Path("sparse/0")
CAMERAS_FILE, IMAGES_FILE, POINTS_FILE = "cameras.txt", "images.txt", "points3D.txt"
GEO_FILE = "geo.txt"

CameraNumbers = Mapping[tuple[int, Intrinsics], int]


def export_colmap(source: Source, folder: Path, *, points: int) -> Exported:
    """Write images/, sparse/0/ and, for a georeferenced mission, geo.txt.

    Raises CovreconError, and OSError if the disk refuses it.
    """
    taken = write_images(source, folder)
    cloud, notes = sparse_points(source, points)
    numbers = _camera_numbers(taken.views)
    model = folder / MODEL_FOLDER
    model.mkdir(parents=True, exist_ok=True)
    georeference = Georeference.of(source.mission)
    files: dict[Path, Iterator[str]] = {
        model / CAMERAS_FILE: _cameras(numbers),
        model / IMAGES_FILE: _images(taken.views, numbers),
        model / POINTS_FILE: _points(cloud),
    }
    if georeference is not None:
        files[folder / GEO_FILE] = _places(taken.views, georeference)
    for file, lines in files.items():
        with file.open("w", encoding="ascii", newline="\n") as stream:
            stream.writelines(line + "\n" for line in lines)
    write_georeference(folder, georeference)
    content = f"{MODEL_FOLDER} with {len(taken.views)} images of {len(numbers)} cameras"
    return Exported(folder, content, (*taken.left_out, *notes))


def _camera_numbers(views: tuple[View, ...]) -> CameraNumbers:
    """COLMAP counts cameras from 1: one for each drone, and each set of intrinsics that it had."""
    distinct = dict.fromkeys((view.drone, view.intrinsics) for view in views)
    return {camera: number for number, camera in enumerate(sorted(distinct, key=lambda each: each[0]), 1)}


def _cameras(numbers: CameraNumbers) -> Iterator[str]:
    yield "# CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy"
    for (_, camera), number in numbers.items():
        parameters = _numbers(camera.fx, camera.fy, camera.cx, camera.cy)
        yield f"{number} PINHOLE {camera.width} {camera.height} {parameters}"


def _images(views: tuple[View, ...], numbers: CameraNumbers) -> Iterator[str]:
    """Two lines an image; the second, of the points found in it, stays empty."""
    yield "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME (world to camera)"
    for number, view in enumerate(views, 1):
        to_camera = view.rotation.T
        quaternion = Rotation.from_matrix(to_camera).as_quat(canonical=True, scalar_first=True)
        pose = _numbers(*quaternion, *(-to_camera @ view.position))
        yield f"{number} {pose} {numbers[view.drone, view.intrinsics]} {view.name}"
        yield ""


def _points(cloud: NDArray[np.void] | None) -> Iterator[str]:
    yield "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"
    for number, point in enumerate(cloud if cloud is not None else (), 1):
        x, y, z, _, _, _, *colour = point.tolist()
        yield f"{number} {x:.6f} {y:.6f} {z:.6f} {' '.join(map(str, colour))} 0"


def _places(views: tuple[View, ...], georeference: Georeference) -> Iterator[str]:
    """Latitude, longitude in degrees, altitude in metres: 1e-9 degrees are a tenth of a millimetre."""
    places = georeference.geodetic(np.array([view.position for view in views]))
    for view, (latitude, longitude, altitude) in zip(views, places, strict=True):
        yield f"{view.name} {latitude:.9f} {longitude:.9f} {altitude:.4f}"


def _numbers(*values: float) -> str:
    """Every digit, so that nothing is lost on the way through text."""
    return " ".join(repr(float(value)) for value in values)
