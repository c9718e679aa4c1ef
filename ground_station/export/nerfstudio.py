"""nerfstudio's ``transforms.json``, which trainers of radiance fields and Gaussian splats read."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.export.georeference import Georeference
from ground_station.export.meshes import cloud_ply
from ground_station.export.output import Exported, write_georeference
from ground_station.export.source import Source
from ground_station.export.sparse import sparse_points
from ground_station.export.views import DEPTHS_FOLDER, IMAGES_FOLDER, View, write_images
from protocol.geometry import Floats, Intrinsics

TRANSFORMS_FILE = "transforms.json"
POINTS_FILE = "sparse.ply"

OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0])
"""nerfstudio's camera looks along -z with y up; ours, OpenCV's, along z with y down."""


def export_nerfstudio(source: Source, folder: Path, *, points: int) -> Exported:
    """Write transforms.json, images/ and, with a map, sparse.ply of ``points`` points to begin from.

    Raises CovreconError, and OSError if the disk refuses it. transforms.json comes last: with it all is there.
    """
    taken = write_images(source, folder)
    cloud, notes = sparse_points(source, points)
    if cloud is not None:
        (folder / POINTS_FILE).write_bytes(cloud_ply(cloud))
    write_georeference(folder, Georeference.of(source.mission))
    content = transforms(taken.views, with_points=cloud is not None)
    (folder / TRANSFORMS_FILE).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return Exported(folder, f"{TRANSFORMS_FILE} with {len(taken.views)} images", (*taken.left_out, *notes))


def transforms(views: tuple[View, ...], *, with_points: bool) -> dict[str, Any]:
    """The content of transforms.json. Poses are in the world frame, metres; intrinsics go by frame, as each drone has
    a camera of its own. Depth is spoken of where all images have it: nerfstudio refuses less."""
    deep = all(view.depth for view in views)
    return {
        "camera_model": "PINHOLE",
        # nerfstudio would turn the world until the cameras' mean "up" is up; cameras that look down have none.
        "orientation_override": "none",
        **({"ply_file_path": POINTS_FILE} if with_points else {}),
        "frames": [
            {
                "file_path": f"{IMAGES_FOLDER}/{view.name}",
                **({"depth_file_path": f"{DEPTHS_FOLDER}/{view.depth}"} if deep else {}),
                **_intrinsics(view.intrinsics),
                "transform_matrix": camera_to_world(view).tolist(),
            }
            for view in views
        ],
    }


def camera_to_world(view: View) -> Floats:
    """(4, 4) with OpenGL's camera axes."""
    matrix = np.eye(4)
    matrix[:3, :3] = view.rotation @ OPENCV_TO_OPENGL
    matrix[:3, 3] = view.position
    return matrix


def _intrinsics(camera: Intrinsics) -> dict[str, float]:
    names = {"width": "w", "height": "h", "fx": "fl_x", "fy": "fl_y"}
    return {names.get(name, name): value for name, value in asdict(camera).items()}
