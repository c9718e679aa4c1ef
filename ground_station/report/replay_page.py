"""The flight as a page in which one can look around and play: one file, opened from disk, that asks for nothing.

viser records what a server would send to its browser, so one is started for a moment, on the loopback interface.
"""

from __future__ import annotations

import contextlib
import html
import io
import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ground_station.console.field_view import heat
from ground_station.mesh_files import glb
from ground_station.palette import drone_colour
from ground_station.report.replay_scene import Frame, Scene
from ground_station.report.run_data import FieldMoment, MapMoment
from protocol.airspace import outlines
from protocol.geometry import Floats, camera_rotation
from protocol.mission import Mission

if TYPE_CHECKING:
    import viser

Rgb = tuple[int, int, int]

FRUSTUM_M = 0.3
POINT_CELLS = 0.1
"""Diameter of a point of the importance, of the distance between two."""
TRAIL_PX = 2.0
BOX_PX = 1.5
PER_METRE = 1024
"""Positions are rounded to a part of a metre that float32 holds exactly: the page becomes smaller by a third."""
FINER = 4096
"""Likewise for quaternions."""
Y_UP = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
"""Rotation (w, x, y, z) from glTF's axes to the world's."""
REGION_COLOUR, TARGET_COLOUR, ZONE_COLOUR = (154, 165, 177), (82, 96, 109), (198, 40, 40)
VIEW = np.array([-0.75, -1.0, 0.8])
"""Where the page first looks from: this direction from the middle of the target B, times its diagonal."""
LINGER_S = 2.0
"""Time of play for which the end is shown."""


def replay_page(scene: Scene, mission: Mission) -> str:
    """The page's text. The same scene gives the same text."""
    import viser

    with contextlib.redirect_stdout(io.StringIO()):  # viser greets, and says good-bye
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            return _titled(_recorded(server, scene, mission), mission.name)
        finally:
            server.stop()


def _titled(page: str, name: str) -> str:
    return page.replace("<title>Viser</title>", f"<title>{html.escape(name)} · Coverage-Recon replay</title>", 1)


def _recorded(server: viser.ViserServer, scene: Scene, mission: Mission) -> str:
    stage = _Stage(server, scene, mission)
    serializer = server.get_scene_serializer()
    stage.show(scene.frames[0])
    for before, frame in itertools.pairwise(scene.frames):
        serializer.insert_sleep((frame.time_s - before.time_s) / scene.speed)
        stage.show(frame)
    serializer.insert_sleep(LINGER_S)
    return serializer.as_html()


class _Stage:
    """viser's scene, one frame after another."""

    def __init__(self, server: viser.ViserServer, scene: Scene, mission: Mission) -> None:
        self._scene = server.scene
        self._colours = [_rgb(drone_colour(index)) for index in range(len(scene.drones))]
        self._cell_m = mission.target.cell_m
        lower, upper = np.array(mission.target.lower_m), np.array(mission.target.upper_m)
        middle, diagonal = (lower + upper) / 2, float(np.linalg.norm(upper - lower))
        server.initial_camera.position = middle + diagonal * VIEW
        server.initial_camera.look_at = middle
        server.initial_camera.fov = math.radians(45)
        self._scene.world_axes.visible = False
        self._box("/flight region", mission.flight.lower_m, mission.flight.upper_m, REGION_COLOUR)
        self._box("/target", mission.target.lower_m, mission.target.upper_m, TARGET_COLOUR)
        zones = outlines(mission.flight)
        if len(zones):
            self._line("/zones", zones, ZONE_COLOUR, BOX_PX)
        self._caption = self._scene.add_label(
            "/caption", "", position=(middle[0], middle[1], upper[2] + 0.2 * diagonal), anchor="center-center"
        )
        camera = mission.camera.intrinsics()
        fov, aspect = 2 * math.atan(camera.height / 2 / camera.fy), camera.width / camera.height
        self._cameras = [
            self._scene.add_camera_frustum(
                f"/drones/{drone}", fov, aspect, scale=FRUSTUM_M, color=colour, visible=False, variant="filled"
            )
            for drone, colour in zip(scene.drones, self._colours, strict=True)
        ]
        for drone in scene.drones:
            self._scene.add_label(f"/drones/{drone}/name", str(drone), anchor="bottom-center", font_screen_scale=0.8)
        self._pieces = 0
        self._map: viser.GlbHandle | None = None
        self._field: viser.PointCloudHandle | None = None

    def show(self, frame: Frame) -> None:
        self._caption.text = frame.caption
        for camera, pose in zip(self._cameras, frame.poses, strict=True):
            if np.isfinite(pose[0]):
                camera.visible = True
                camera.position, camera.wxyz = _rounded(pose[:3], PER_METRE), _quaternion(pose)
        for index, path in enumerate(frame.trails):
            if len(path) > 1:
                points = _rounded(np.stack([path[:-1], path[1:]], axis=1), PER_METRE)
                self._line(f"/trails/{index}/{self._pieces}", points, self._colours[index], TRAIL_PX)
        self._pieces += bool(frame.trails)
        if frame.map is not None:
            self._show_map(frame.map)
        if frame.field is not None:
            self._show_field(frame.field)

    def _show_map(self, moment: MapMoment) -> None:
        if self._map is not None:
            self._map.remove()
        mesh = moment.mesh
        content = glb(_rounded(mesh.vertices, PER_METRE).astype(np.float32), mesh.faces, mesh.colours)
        # A name of its own for each: the player loads them side by side, and the last to be ready would win.
        self._map = self._scene.add_glb(f"/map/{moment.time_s:.3f}", content, wxyz=Y_UP)

    def _show_field(self, moment: FieldMoment) -> None:
        if self._field is not None:
            self._field.remove()
        self._field = self._scene.add_point_cloud(
            f"/importance/{moment.time_s:.3f}",
            _rounded(moment.positions, PER_METRE),
            heat(moment.importance),
            point_size=POINT_CELLS * self._cell_m,
            point_shape="circle",
            point_shading="flat",
        )

    def _box(self, name: str, lower: Sequence[float], upper: Sequence[float], colour: Rgb) -> None:
        corners = np.array(list(itertools.product(*zip(lower, upper, strict=True))))
        edges = [(a, b) for a, b in itertools.combinations(range(8), 2) if (a ^ b).bit_count() == 1]
        self._line(name, corners[np.array(edges)], colour, BOX_PX)

    def _line(self, name: str, points: Floats, colour: Rgb, width_px: float) -> None:
        """``points``: ends of its pieces, (n, 2, 3)."""
        self._scene.add_line_segments(
            name, points.astype(np.float32), colour, thickness=width_px, thickness_units="screen"
        )


def _rgb(colour: str) -> Rgb:
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def _quaternion(pose: Floats) -> Floats:
    """w, x, y, z of the camera's rotation; viser's cameras look along z with y down, as ours do."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_matrix(camera_rotation(float(pose[3]), float(pose[4])))
    return _rounded(rotation.as_quat(canonical=True, scalar_first=True), FINER)


def _rounded(values: NDArray[Any], parts: int) -> Floats:
    return np.asarray(np.round(values.astype(np.float64) * parts) / parts)
