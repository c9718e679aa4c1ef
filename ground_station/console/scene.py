"""The three-dimensional picture: map, importance, drones and what pulls the chosen one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from itertools import product
from typing import Literal, cast

import numpy as np
import viser
from numpy.typing import NDArray

from ground_station import mesh_files
from ground_station.console.drone_view import orientation
from ground_station.console.explanation import Explanation
from ground_station.console.field_view import Colours, FieldView, PointCloud, drone_colours
from ground_station.console.free_view import Cut, FreeView
from ground_station.console.mesh_cache import Key, MeshCache, Redraw
from ground_station.console.orders_panel import Post
from ground_station.console.situation import Situation
from protocol.airspace import outlines
from protocol.field import VirtualField
from protocol.geometry import Floats
from protocol.messages import MeshBlock
from protocol.mission import Mission

Y_UP = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
"""Quaternion w, x, y, z from glTF's axes, y up, to the world's."""
UPRIGHT = "/map/upright"
"""Parent of all that is glTF: turned once, because a block that is drawn anew shows for a moment unturned."""
GREY = (168, 172, 178)
TARGET_COLOUR, FLIGHT_COLOUR, GRID_COLOUR = (255, 212, 59), (90, 96, 104), (60, 64, 70)
ZONE_COLOUR = (240, 101, 92)
BODY_M, FRUSTUM_M = 0.08, 0.3
"""Radius of the ball that stands for a drone, and size of its camera's pyramid."""
LINE_PX, BOX_PX, ZONE_PX = 2.0, 1.0, 1.5
AMBIENT = 1.5
"""Light from everywhere: the map's colours have their light and shade from the pictures."""
FREE_COLOUR, NOT_FREE_COLOUR = (64, 192, 140, 56), (240, 101, 92, 120)
"""With alpha: of the cut through the free space."""
PIXELS = 4
"""Of a cell along each axis: a browser blurs one into the next."""
POINT_SHARE = 0.12
"""Size of a point of the importance, of the distance of two."""
PULL_PX = 12.0
"""Thickness of the line to a place that has the whole pull."""
HIDE_BELOW = 0.3
VIEW_DISTANCE = 0.95
"""Of the first view, of the diagonal of the target box."""

MapStyle = Literal["colours", "grey", "hidden"]
FieldStyle = Literal["importance", "owners", "hidden"]
FreeStyle = Literal["hidden", "at the drone's height", "at a height"]


class ViewOptions:
    """What the operator wants to see; shared by all pages."""

    def __init__(self, gui: viser.GuiApi, mission: Mission) -> None:
        self._map = gui.add_dropdown("Map", ("colours", "grey", "hidden"))
        self._field = gui.add_dropdown("Importance", ("importance", "owners", "hidden"))
        self._hide_below = gui.add_slider("Hide below", min=0.0, max=1.0, step=0.05, initial_value=HIDE_BELOW)
        self._trails = gui.add_checkbox("Trails", initial_value=True)
        self._pulls = gui.add_checkbox("Pulls on the chosen drone", initial_value=True)
        self._free: viser.GuiDropdownHandle[FreeStyle] | None = None
        if mission.flight.obstacles.enabled:
            self._free = gui.add_dropdown("Free space", ("hidden", "at the drone's height", "at a height"))
            low, high = mission.flight.lower_m[2], mission.flight.upper_m[2]
            step = mission.flight.obstacles.cell_m
            self._height = gui.add_slider("Height, m", low, high, step, (low + high) / 2, visible=False)
            self._free.on_update(self._show_height)

    def _show_height(self, _: object) -> None:
        self._height.visible = self.free == "at a height"

    def when_map_changes(self, call: Callable[[], None], post: Post) -> None:
        self._map.on_update(lambda _: post(call))

    @property
    def map(self) -> MapStyle:
        return cast("MapStyle", self._map.value)

    @property
    def field(self) -> FieldStyle:
        return cast("FieldStyle", self._field.value)

    @property
    def hide_below(self) -> float:
        return float(self._hide_below.value)

    @property
    def trails(self) -> bool:
        return self._trails.value

    @property
    def free(self) -> FreeStyle:
        return "hidden" if self._free is None else self._free.value

    @property
    def height_m(self) -> float:
        """Of the cut through the free space, if it is "at a height"."""
        return float(self._height.value)

    @property
    def pulls(self) -> bool:
        return self._pulls.value


class Scene:
    def __init__(self, server: viser.ViserServer, mission: Mission, options: ViewOptions, post: Post) -> None:
        self._scene, self._options = server.scene, options
        self._ids = [drone.id for drone in mission.drones]
        self._colours = drone_colours(range(len(mission.drones)))
        self._field = FieldView(VirtualField.of(mission.target), mission.sensing)
        self._free = FreeView(mission) if mission.flight.obstacles.enabled else None
        self._cut: int | None = None
        """Level that is drawn."""
        self._near: tuple[float, ...] | None = None
        """Place of the drone whose nearest cell is drawn."""
        self._map = MeshCache()
        self._drawn: dict[Key, viser.SceneNodeHandle] = {}
        _set_stage(server, mission)
        self._drones = {
            number: _Drone(server.scene, number, colour, mission)
            for number, colour in zip(self._ids, self._colours, strict=True)
        }
        server.scene.add_frame(UPRIGHT, wxyz=Y_UP, show_axes=False)
        options.when_map_changes(self._restyle_map, post)

    # --- drones --------------------------------------------------------------------------------------------------

    def draw_drones(self, situation: Situation) -> None:
        for number, state in situation.states().items():
            self._drones[number].move(state.pose, state.mode)

    def draw_trails(self, situation: Situation) -> None:
        for number, drone in situation.drones.items():
            self._drones[number].trace(drone.trail.segments if self._options.trails else None)

    def draw_pulls(self, explanation: Explanation | None, situation: Situation) -> None:
        """Lines from the drone to the places that pull it most, the thicker the stronger."""
        name = "/pulls"
        states = situation.states()
        if not self._options.pulls or explanation is None or explanation.drone not in states:
            self._scene.remove_by_name(name)
            return
        start = states[explanation.drone].pose[:3]
        colour = self._colours[self._ids.index(explanation.drone)]
        self._scene.add_frame(name, show_axes=False)
        for place, pull in enumerate(explanation.pulls):
            if pull.share > 0:
                self._scene.add_line_segments(
                    f"{name}/{place}",
                    np.array([[start, pull.position]], np.float32),
                    colour,
                    thickness=PULL_PX * pull.share,
                    thickness_units="screen",
                )

    # --- importance ----------------------------------------------------------------------------------------------

    def draw_field(self, phi: NDArray[np.float32], ids: list[int], poses: Floats) -> None:
        """phi (positions, directions), poses (drones, 5) of the drones ``ids``."""
        style = self._options.field
        if style == "hidden":
            self._draw_points(None)
        elif style == "owners" and ids:
            colours = np.stack([self._colours[self._ids.index(number)] for number in ids])
            self._draw_points(self._field.by_owner(phi, self._options.hide_below, poses, colours))
        else:
            self._draw_points(self._field.by_importance(phi, self._options.hide_below))

    def _draw_points(self, cloud: PointCloud | None) -> None:
        name = "/importance"
        if cloud is None or not len(cloud.points):
            self._scene.remove_by_name(name)
            return
        size = POINT_SHARE * self._field.pitch_m
        self._scene.add_point_cloud(name, cloud.points, cloud.colours, point_size=size, point_shape="circle")

    # --- free space ----------------------------------------------------------------------------------------------

    def draw_free(self, chosen: int, situation: Situation) -> None:
        """The cut at its height, and what of what is not free is nearest to the drone ``chosen``."""
        if self._free is None:
            return
        style, state = self._options.free, situation.states().get(chosen)
        place = None if state is None else state.pose[:3]
        height_m = self._options.height_m if style == "at a height" else place and place[2]
        if style == "hidden" or height_m is None:
            self._scene.remove_by_name("/free")
            self._cut = self._near = None
            return
        changed = self._free.take(situation.free)
        level = self._free.level(height_m)
        if changed or level != self._cut:
            if self._cut is None:
                self._scene.add_frame("/free", show_axes=False)
            self._draw_cut(self._free.cut(level), self._free)
            self._cut = level
        if changed or place != self._near:
            self._near = place
            self._draw_nearest(self._free, place)

    def _draw_cut(self, cut: Cut, view: FreeView) -> None:
        grid = view.grid
        width, height = (grid.cell_m * count for count in grid.shape[:2])
        cells = np.where(cut.free[..., None], *(np.array(rgba, np.uint8) for rgba in (FREE_COLOUR, NOT_FREE_COLOUR)))
        self._scene.add_image(
            "/free/cut",
            cells.transpose(1, 0, 2).repeat(PIXELS, axis=0).repeat(PIXELS, axis=1),  # its first row at the lowest y
            width,
            height,
            cast_shadow=False,
            receive_shadow=False,
            position=(grid.origin[0] + width / 2, grid.origin[1] + height / 2, cut.height_m),
        )
        self._draw_lines("/free/borders", cut.borders)

    def _draw_nearest(self, view: FreeView, place: tuple[float, ...] | None) -> None:
        nearest = None if place is None else view.nearest(np.array(place))
        if place is None or nearest is None:
            self._draw_lines("/free/nearest", np.empty((0, 2, 3), np.float32))
            self._scene.remove_by_name("/free/distance")
            return
        cell = _edges(nearest.low, nearest.low + view.grid.cell_m)
        line = np.array([[place, nearest.point]], np.float32)
        self._draw_lines("/free/nearest", np.concatenate([cell, line]))
        self._scene.add_label("/free/distance", f"{nearest.distance_m:.2f} m", position=nearest.point)

    def _draw_lines(self, name: str, segments: NDArray[np.float32]) -> None:
        if len(segments):
            self._scene.add_line_segments(name, segments, ZONE_COLOUR, thickness=ZONE_PX, thickness_units="screen")
        else:
            self._scene.remove_by_name(name)

    # --- map -----------------------------------------------------------------------------------------------------

    @property
    def map(self) -> MeshCache:
        return self._map

    def draw_map(self, redraw: Redraw) -> None:
        for key in redraw.remove:
            self._erase(key)
        self._draw_blocks(redraw.draw)

    def _restyle_map(self) -> None:
        for key in list(self._drawn):
            self._erase(key)
        self._draw_blocks(self._map.blocks.values())

    def _erase(self, key: Key) -> None:
        block = self._drawn.pop(key, None)
        if block is not None:  # nothing is drawn while the map is hidden
            block.remove()

    def _draw_blocks(self, blocks: Iterable[MeshBlock]) -> None:
        style = self._options.map
        for block in blocks if style != "hidden" else ():
            name = "_".join(map(str, block.key))
            if style == "grey":
                self._drawn[block.key] = self._scene.add_mesh_simple(
                    f"/map/{name}", block.vertices, block.faces, color=GREY, flat_shading=True, side="double"
                )
            else:
                content = mesh_files.glb(block.vertices, block.faces, block.colours)
                self._drawn[block.key] = self._scene.add_glb(f"{UPRIGHT}/{name}", content)


class _Drone:
    """A ball, a camera, a number and a trail, in the drone's colour."""

    def __init__(self, scene: viser.SceneApi, number: int, colour: Colours, mission: Mission) -> None:
        self._scene, self._number, self._colour = scene, number, colour
        camera = mission.camera.intrinsics()
        name = f"/drones/{number}"
        self._body = scene.add_frame(name, show_axes=False, visible=False)
        scene.add_icosphere(f"{name}/body", radius=BODY_M, color=colour)
        self._camera = scene.add_camera_frustum(
            f"{name}/camera",
            fov=2 * math.atan(camera.height / 2 / camera.fy),
            aspect=camera.width / camera.height,
            scale=FRUSTUM_M,
            thickness=LINE_PX,
            thickness_units="screen",
            color=colour,
        )
        self._shown: tuple[tuple[float, ...], str] | None = None
        self._traced = 0
        self._label = scene.add_label(f"{name}/label", str(number), position=(0.0, 0.0, 2 * BODY_M))

    def move(self, pose: tuple[float, ...], mode: str) -> None:
        """What has not changed is not sent: the browser draws only when something comes."""
        if (pose, mode) == self._shown:
            return
        self._shown = (pose, mode)
        self._body.position = np.array(pose[:3])
        self._camera.wxyz = orientation(pose[3], pose[4])
        self._label.text = str(self._number) if mode == "flying" else f"{self._number} {mode}"
        self._body.visible = True

    def trace(self, segments: NDArray[np.float32] | None) -> None:
        name = f"/trails/{self._number}"
        traced = 0 if segments is None else len(segments)
        if traced == self._traced:
            return
        self._traced = traced
        if segments is None or not len(segments):
            self._scene.remove_by_name(name)
        else:
            self._scene.add_line_segments(name, segments, self._colour, thickness=LINE_PX, thickness_units="screen")


def _set_stage(server: viser.ViserServer, mission: Mission) -> None:
    """What does not move: floor, the box that is to be mapped, where the drones may fly, and the first view."""
    scene, target, flight = server.scene, mission.target, mission.flight
    low, high = np.array(target.lower_m), np.array(target.upper_m)
    centre, size = (low + high) / 2, high - low
    scene.configure_default_lights(cast_shadow=False)
    scene.configure_environment_map(None)  # both cost a computer without a graphics card half of each frame
    scene.add_light_ambient("/light", intensity=AMBIENT)
    scene.world_axes.visible = False
    scene.set_up_direction("+z")
    scene.add_grid(
        "/floor",
        width=float(flight.upper_m[0] - flight.lower_m[0]),
        height=float(flight.upper_m[1] - flight.lower_m[1]),
        position=(centre[0], centre[1], low[2]),
        cell_color=GRID_COLOUR,
        section_color=GRID_COLOUR,
    )
    for name, box, colour in (("/target", target, TARGET_COLOUR), ("/flight", flight, FLIGHT_COLOUR)):
        scene.add_line_segments(
            name,
            _edges(np.array(box.lower_m), np.array(box.upper_m)),
            colour,
            thickness=BOX_PX,
            thickness_units="screen",
        )
    zones = outlines(flight).astype(np.float32)
    if len(zones):
        scene.add_line_segments("/zones", zones, ZONE_COLOUR, thickness=ZONE_PX, thickness_units="screen")
    diagonal = float(np.linalg.norm(size))
    server.initial_camera.look_at = centre
    server.initial_camera.position = centre + VIEW_DISTANCE * diagonal * np.array([-0.55, -0.55, 0.6])


def _edges(low: Floats, high: Floats) -> NDArray[np.float32]:
    """(12, 2, 3), of the box between two corners."""
    corners = np.array(list(product(*zip(low, high, strict=True))), np.float32)
    pairs = [(one, other) for one in range(8) for other in range(one) if (one ^ other).bit_count() == 1]
    edges: NDArray[np.float32] = corners[np.array(pairs)]
    return edges
