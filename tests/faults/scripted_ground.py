"""A whole mission as far as a console can tell, without any other process: drones that obey at once, and a map."""

from __future__ import annotations

import asyncio
import io
import math
from collections.abc import AsyncIterator, Collection
from contextlib import asynccontextmanager, suppress

import numpy as np
import trimesh
from PIL import Image

from ground_station.commands import Command, CommandDesk, parse_command, refusal
from ground_station.mesh_blocks import MeshBlocks
from ground_station.reconstruction.reconstructor import Mesh
from protocol import topics
from protocol.bus import Bus
from protocol.errors import MessageError
from protocol.geometry import camera_rotation
from protocol.messages import (
    CommandReply,
    Control,
    DroneState,
    DroneStatus,
    Event,
    EventLevel,
    FreeCells,
    JumpHead,
    Keyframe,
    MeshPage,
    MissionPhase,
    Mode,
    Phase,
    Status,
    Tick,
    Vector5,
)
from protocol.mission import Mission
from protocol.obstacle_grid import ObstacleGrid
from protocol.replication import Replication
from protocol.synchroniser import blocks_of
from protocol.topics import M

EPOCH = 7
CIRCLE_RADPS = 0.5
STATUS_TICKS, KEYFRAME_TICKS = 10, 20
EDGE_M, CHEQUER_M = 0.15, 0.3
MODES: dict[str, Mode] = {"fly": "flying", "hold": "holding", "return": "returning", "land": "landing"}


class ScriptedGround:
    """Ground station, simulator and agents on one bus. Its clock is the loop's."""

    def __init__(self, mission: Mission, bus: Bus, circle_m: float = 0.0) -> None:
        """``circle_m``: radius of the circles that drones fly around their starts."""
        self._mission, self._bus, self._circle_m = mission, bus, circle_m
        self._replication = Replication(mission, authority=True, epoch=EPOCH)
        self._blocks = MeshBlocks()
        self._blocks.update(_room(mission))
        self.tick = 0
        self.deaf: Collection[int] = ()
        """Drones that acknowledge nothing."""
        self.told: list[Command] = []
        """Commands that were accepted, each once."""
        self.asked = 0
        """Questions about commands."""
        self.silent = False
        """Says and answers nothing, like one that is gone."""
        self.begin()
        bus.serve(topics.COMMAND, self._obey)
        bus.serve(topics.MAP, self._show_map)
        bus.serve(topics.BLOCKS, blocks_of(self._replication))
        for role in ("ground", "sim", *(f"drone/{drone.id}" for drone in mission.drones)):
            bus.announce(role)

    def begin(self, phase: Phase = "flying") -> None:
        """As if nothing had ever been commanded."""
        self.phase: Phase = phase
        self._desk = CommandDesk([drone.id for drone in self._mission.drones])
        self.told.clear()
        self.deaf, self.silent = (), False

    @asynccontextmanager
    async def flying(self) -> AsyncIterator[None]:
        task = asyncio.create_task(self._fly())
        try:
            yield
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    def say(self, level: EventLevel, text: str, source: str = "ground") -> None:
        event = Event(source=source, tick=self.tick, level=level, kind="test", text=text)
        drone = source.removeprefix("drone/")
        if drone == source:
            self._put(topics.GROUND_EVENT, event)
        else:
            self._put(topics.EVENT, event, drone)

    # --- what is asked -------------------------------------------------------------------------------------------

    async def _obey(self, parameters: dict[str, str]) -> CommandReply:
        self._refuse_if_silent()
        self.asked += 1
        identity, verb, drones = parse_command(parameters)
        if not self._desk.known(identity):
            command = self._desk.consider(identity, verb, drones, self.phase)
            if isinstance(command, str):
                return refusal(identity, command)
            self._desk.take(command)
            self.told.append(command)
            if verb == "start":
                self.phase = "flying"
        return self._desk.reply(identity)

    async def _show_map(self, parameters: dict[str, str]) -> MeshPage:
        self._refuse_if_silent()
        return self._blocks.page(int(parameters["since"]), int(parameters["epoch"]))

    def _refuse_if_silent(self) -> None:
        if self.silent:
            raise MessageError("silent")

    # --- what is said --------------------------------------------------------------------------------------------

    async def _fly(self) -> None:
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        while True:
            self._beat()
            self.tick += 1
            await asyncio.sleep(began_s + self.tick * self._mission.tick_s - loop.time())

    def _beat(self) -> None:
        ids = tuple(drone.id for drone in self._mission.drones)
        tick = Tick(
            tick=self.tick,
            time_s=self.tick * self._mission.tick_s,
            lockstep=False,
            live=ids,
            vehicles=(),
            jump_epoch=EPOCH,
            next_jump=0,
            keyframes=0,
        )
        self._replication.hear_tick(tick)
        self._put(topics.TICK, tick)
        orders = {order.drone: order for order in self._desk.orders}
        for number in ids:
            order = orders.get(number)
            heard = order.number if order is not None and number not in self.deaf else 0
            self._desk.acknowledge(number, heard)
            state = self._state(number, MODES[order.action if heard and order else "fly"], heard)
            self._replication.hear_state(state)
            self._put(topics.STATE, state, number)
            if self.tick % KEYFRAME_TICKS == 0:
                self._put(topics.KEYFRAME, self._keyframe(number), number)
        self._replication.integrate(self.tick, (), 0)
        head = JumpHead(epoch=EPOCH, next_sequence=0, done=self.tick + 1, phase=self.phase)
        self._put(topics.HEAD, head)
        if self.tick % STATUS_TICKS == 0:
            self._put(topics.STATUS, self._status())
            self._tell_free()
            self._put(topics.PHASE, MissionPhase(phase=self.phase, reason="", orders=self._desk.orders))

    def _tell_free(self) -> None:
        """More of the room each time, from one wall on; and less again when all of it was free."""
        if self._mission.flight.obstacles.enabled:
            grid = ObstacleGrid.of(self._mission)
            columns = np.arange(grid.shape[0]) < self.tick // STATUS_TICKS % (grid.shape[0] + 1)
            seen = np.broadcast_to(columns[:, None, None], grid.shape)
            self._put(topics.FREE, FreeCells(tick=self.tick, packed=grid.pack(seen)))

    def _put(self, topic: topics.Topic[M], message: M, drone: int | str = "") -> None:
        if not self.silent:
            self._bus.put(topic, message, drone)

    def _pose(self, number: int) -> Vector5:
        x, y, z, yaw, pitch = self._mission.drone(number).start
        angle = CIRCLE_RADPS * self.tick * self._mission.tick_s if self._circle_m else 0.0
        return x + self._circle_m * math.cos(angle), y + self._circle_m * math.sin(angle), z, yaw + angle, pitch

    def _state(self, number: int, mode: Mode, obeyed: int) -> DroneState:
        zero = (0.0, 0.0, 0.0, 0.0, 0.0)
        control = Control(
            tick=max(0, self.tick - 1),
            outcome="solved",
            velocity=zero,
            slack=0.0,
            sampling=0.01,
            solve_s=0.0012,
            separation_margin_m2=0.4,
            region_margin_m=0.8,
            pitch_margin_rad2=0.1,
            active=("separation:3",) if number == 1 else (),
            fallbacks=0,
            refused=0,
        )
        return DroneState(
            drone=number,
            tick=self.tick,
            pose=self._pose(number),
            velocity=zero,
            battery=0.9,
            mode=mode,
            obeyed=obeyed,
            importance=self._replication.importance,
            replica=self._replication.state(),
            control=control,
        )

    def _keyframe(self, number: int) -> Keyframe:
        x, y, z, yaw, pitch = self._pose(number)
        camera = self._mission.camera.intrinsics()
        shade = np.full((camera.height, camera.width, 3), 40 + 30 * (number % 7), np.uint8)
        jpeg = io.BytesIO()
        Image.fromarray(shade).save(jpeg, "jpeg")
        return Keyframe(
            drone=number,
            sequence=self.tick // KEYFRAME_TICKS,
            tick=self.tick,
            position=(x, y, z),
            rotation=tuple(map(tuple, camera_rotation(yaw, pitch).tolist())),  # type: ignore[arg-type]  # three by three
            width=camera.width,
            height=camera.height,
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            jpeg=jpeg.getvalue(),
        )

    def _status(self) -> Status:
        rows = [
            DroneStatus(
                drone=drone.id,
                alive=True,
                mode="flying",
                position=self._pose(drone.id)[:3],
                speed_mps=0.0,
                separation_m=1.5,
                slack=0.0,
                solve_s=0.0012,
                fallbacks=0,
            )
            for drone in self._mission.drones
        ]
        return Status(
            phase=self.phase,
            activity="flying by a script",
            tick=self.tick,
            time_s=self.tick * self._mission.tick_s,
            importance=self._replication.importance,
            f_score_visible=1 - self._replication.importance,
            f_score_objects=(1 - self._replication.importance) / 2,
            keyframes=self.tick // KEYFRAME_TICKS,
            dropped=0,
            replica=self._replication.state(),
            refused=0,
            unwritten=0,
            loop_lag_s=0.0,
            keyframes_per_s=1.0,
            jumps=0,
            min_separation_m=1.5,
            drones=tuple(rows),
        )


def _room(mission: Mission) -> Mesh:
    """A chequered floor with a box on it."""
    low, high = np.array(mission.target.lower_m), np.array(mission.target.upper_m)
    centre, size = (low + high) / 2, high - low
    floor = trimesh.creation.box((size[0], size[1], 0.02))
    floor.apply_translation((centre[0], centre[1], low[2]))
    box = trimesh.creation.box(size / 3)
    box.apply_translation((centre[0], centre[1], low[2] + size[2] / 6))
    vertices = np.vstack([floor.vertices, box.vertices])
    faces = np.vstack([floor.faces, box.faces + len(floor.vertices)])
    vertices, faces = trimesh.remesh.subdivide_to_size(vertices, faces, EDGE_M)  # type: ignore[no-untyped-call]  # trimesh has no types
    chequers = np.floor(vertices / CHEQUER_M).sum(axis=1).astype(int) % 2
    colours = np.where(chequers[:, None], (200, 120, 60), (70, 100, 150))
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), colours.astype(np.uint8))
