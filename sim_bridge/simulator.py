"""The simulated world's process: vehicles, cameras and the mission's clock.

Lockstep: tick k is published, keyframes are rendered while the agents think, and the world steps once every live
agent has answered and the ground station is done up to tick k + 1. Real time: ticks follow the machine's clock and
nobody is waited for. No check is different in simulation.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from protocol import topics
from protocol.bus import Bus, connect
from protocol.errors import ProcessError
from protocol.geometry import Floats
from protocol.messages import Setpoint, Tick, VehicleSample
from protocol.metrics_endpoint import MetricsEndpoint
from protocol.mission import Mission
from protocol.session import Link
from sim_bridge.battery import VehicleBattery
from sim_bridge.believed import BelievedPoses
from sim_bridge.darkroom import Darkroom
from sim_bridge.dynamics import VehicleBody
from sim_bridge.estimate import EstimateError
from sim_bridge.motion_capture import SimulatedCapture
from sim_bridge.observer import Observer
from sim_bridge.roll_call import MissionWatch, wait_for_everybody
from sim_bridge.scanner import Scanner

if TYPE_CHECKING:
    from sim_bridge.contacts import Contacts
    from sim_bridge.lidar import LidarSensor
    from sim_bridge.photographer import Photographer

log = logging.getLogger(__name__)

LOCKSTEP_PATIENCE_S = 60.0
"""An agent that has not answered for so long is flown around: its vehicle brakes, the others go on."""
GROUND_PATIENCE_S = 120.0
"""How long the world goes on without a ground station that could end the mission, beyond what the mission allows; in
lockstep, how long it stands still."""
END_PATIENCE_S = 2.0
"""Drones that ended may have heard of the mission's end before this process does."""
CHECK_S = 0.5
"""How often a tick is said again while the world stands still, for whoever has just come."""


class Simulator:
    def __init__(
        self,
        mission: Mission,
        bus: Bus,
        photographer: Photographer | None,
        lidar: LidarSensor | None = None,
        contacts: Contacts | None = None,
        *,
        lockstep: bool,
    ) -> None:
        """``contacts``: of a mission with a scene."""
        self._mission, self._bus, self._lockstep = mission, bus, lockstep
        self._darkroom = Darkroom(bus, photographer)
        self._bodies = {drone.id: VehicleBody.at(np.array(drone.start)) for drone in mission.drones}
        vehicles = mission.vehicles
        self._batteries = {
            drone: VehicleBattery(mission.simulation.battery, vehicles.battery_swap_s, vehicles.battery_spares)
            for drone in self._bodies
        }
        self._contacts = contacts
        self._scanner = Scanner(bus, lidar, mission.scan_ticks)
        self._capture = SimulatedCapture(mission) if mission.localization.source == "mocap" else None
        noise = mission.simulation.estimate
        self._errors = {
            drone: EstimateError(noise, mission.seed, drone, mission.tick_s)
            for drone in self._bodies
            if not noise.is_silent
        }
        self._believed: BelievedPoses | None = None
        if self._errors or mission.localization.source != "vehicle":
            self._believed = BelievedPoses()
            bus.on(topics.STATE, self._believed.hear)
        self._flown = dict.fromkeys(self._bodies, -1)
        self._silent: set[int] = set()
        self._watch = MissionWatch(bus, mission)
        self._tick = 0
        self._beaten: Tick
        self._ground_seen_s = 0.0
        bus.on(topics.SETPOINT, self._hear_setpoint)
        bus.watch_lives()

    def _hear_setpoint(self, setpoint: Setpoint) -> None:
        """An older one never replaces a newer one, and none is younger than its arrival."""
        body = self._bodies.get(setpoint.drone)
        if body is None or setpoint.tick < self._flown[setpoint.drone]:
            return
        tick = min(setpoint.tick, self._tick)
        body.command(np.array(setpoint.velocity), tick * self._mission.tick_s, self._mission.flight)
        body.landing = (body.landing and not self._may_start(setpoint)) or setpoint.land
        self._flown[setpoint.drone] = tick
        self._silent.discard(setpoint.drone)

    def _may_start(self, setpoint: Setpoint) -> bool:
        """An empty battery carries nobody."""
        return setpoint.take_off and self._batteries[setpoint.drone].share > 0

    async def run(self) -> None:
        """Until the ground station says that the mission is finished.

        Raises:
            ProcessError: nobody appeared, or the ground station stayed away.
        """
        self._bus.announce("sim")
        await wait_for_everybody(self._bus, self._mission)
        await self._watch.wait_for_start()
        loop = asyncio.get_running_loop()
        began = loop.time()
        try:
            while not self._watch.is_over:
                poses = {drone: body.pose for drone, body in self._bodies.items()}
                if self._contacts is not None:
                    self._contacts.note({drone: poses[drone] for drone in poses if not self._bodies[drone].landing})
                if self._believed is not None:
                    self._believed.note_truth(self._tick, poses, self._velocities())
                self._publish(self._beat())
                for seen in [] if self._capture is None else self._capture.look(self._tick, poses):
                    self._bus.put(topics.MOCAP, seen, seen.drone)
                await self._scanner.scan(self._tick, poses, wait=self._lockstep)
                await self._photograph(poses)
                if self._lockstep:
                    await self._wait_for_agents()
                    await self._wait_for_ground()
                else:
                    await asyncio.sleep(max(0.0, began + (self._tick + 1) * self._mission.tick_s - loop.time()))
                    self._require_ground(self._mission.replication.ground_patience_s + GROUND_PATIENCE_S)
                for drone, body in self._bodies.items():
                    body.step(self._mission.tick_s, self._tick * self._mission.tick_s, self._mission.flight)
                    self._use(drone, body)
                for error in self._errors.values():
                    error.step()
                self._tick += 1
        finally:
            self._darkroom.close()
            self._scanner.close()

    def _use(self, drone: int, body: VehicleBody) -> None:
        battery = self._batteries[drone]
        battery.step(self._mission.tick_s, body.velocity, down=body.is_down)
        if battery.share == 0 and not body.landing:
            log.error("tick %d: drone %d: its battery is empty: it comes down here", self._tick, drone)
            body.landing = True

    async def _photograph(self, poses: Mapping[int, Floats]) -> None:
        """What cameras see at ``poses`` (5,), posed where their drones believe to be."""
        believed = self._believed
        if believed is None:
            await self._darkroom.photograph(self._tick, poses, self._velocities(), wait=self._lockstep)
            return
        if self._lockstep:
            tick = self._tick
            await self._stand_still(lambda: believed.has(tick, [*self._live(), *self._aground()]), LOCKSTEP_PATIENCE_S)
        await self._darkroom.photograph_believed(believed.take(), wait=self._lockstep)

    def _velocities(self) -> dict[int, Floats]:
        return {drone: body.velocity for drone, body in self._bodies.items()}

    def _live(self) -> list[int]:
        return [drone for drone in sorted(self._bodies) if self._is_live(drone)]

    def _is_live(self, drone: int) -> bool:
        return self._is_here(drone) and not self._bodies[drone].is_down

    def _is_here(self, drone: int) -> bool:
        return drone not in self._silent and f"drone/{drone}" in self._bus.alive

    def _aground(self) -> list[int]:
        """Those who stand on the ground, where a crew may make them fly again."""
        if self._mission.vehicles.battery_swap_s == 0:
            return []
        return [drone for drone, body in sorted(self._bodies.items()) if body.is_down and self._is_here(drone)]

    def _beat(self) -> Tick:
        if not self._lockstep:
            oldest = self._tick - topics.SETPOINT.max_age_s / self._mission.tick_s
            self._silent = {drone for drone, flown in self._flown.items() if flown < oldest}
        vehicles = [self._sample(drone, body) for drone, body in sorted(self._bodies.items())]
        return Tick(
            tick=self._tick,
            time_s=self._tick * self._mission.tick_s,
            lockstep=self._lockstep,
            live=tuple(self._live()),
            vehicles=tuple(vehicles),
            jump_epoch=self._watch.head.epoch,
            next_jump=self._watch.head.next_sequence,
            keyframes=self._darkroom.sent,
            aground=tuple(self._aground()),
            contacts=() if self._contacts is None else self._contacts.told,
        )

    def _sample(self, drone: int, body: VehicleBody) -> VehicleSample:
        sample = VehicleSample(
            drone=drone,
            pose=tuple(body.pose.tolist()),
            velocity=tuple(body.velocity.tolist()),
            battery=self._batteries[drone].share,
            setpoint_tick=self._flown[drone],
        )
        if self._believed is None:
            return sample
        told: dict[str, object] = {"truth": sample.pose}
        if self._errors:
            error = self._errors[drone]
            position_sd_m, angle_sd_rad = error.deviations
            told |= {
                "pose": tuple(error.pose(body.pose).tolist()),
                "velocity": tuple(error.velocity(body.velocity).tolist()),
                "position_sd_m": position_sd_m,
                "angle_sd_rad": angle_sd_rad,
            }
        return sample.model_copy(update=told)

    def _publish(self, beat: Tick) -> None:
        self._beaten = beat
        self._bus.put(topics.TICK, beat)

    async def _stand_still(self, condition: Callable[[], bool], patience_s: float) -> bool:
        """Wait for ``condition``, saying the tick again for whoever comes meanwhile."""
        deadline = asyncio.get_running_loop().time() + patience_s
        while not await self._bus.until(condition, CHECK_S):
            if asyncio.get_running_loop().time() > deadline:
                return False
            self._publish(self._beaten)
        return True

    async def _wait_for_agents(self) -> None:
        tick = self._tick

        def answered() -> bool:
            aground = self._aground()
            return all(
                flown >= tick or not (self._is_live(drone) or drone in aground) for drone, flown in self._flown.items()
            )

        if not await self._stand_still(answered, LOCKSTEP_PATIENCE_S):
            late = {drone for drone in (*self._live(), *self._aground()) if self._flown[drone] < tick}
            log.error("tick %d: no answer from drones %s: going on without them", tick, sorted(late))
            self._silent |= late
        if self._live() or any(body.is_down for body in self._bodies.values()):
            return
        if not await self._bus.until(lambda: self._watch.is_over, END_PATIENCE_S):
            raise ProcessError(f"tick {tick}: no drone answers")

    async def _wait_for_ground(self) -> None:
        def done() -> bool:
            return self._watch.head.done > self._tick or self._watch.is_over

        if not await self._stand_still(done, GROUND_PATIENCE_S):
            raise ProcessError(f"tick {self._tick}: the ground station is not done after {GROUND_PATIENCE_S:g} s")

    def _require_ground(self, patience_s: float) -> None:
        now_s = asyncio.get_running_loop().time()
        if "ground" in self._bus.alive:
            self._ground_seen_s = now_s
        elif now_s - self._ground_seen_s > patience_s:
            raise ProcessError(f"the ground station has been gone for {patience_s:g} s")


async def run_simulator(mission: Mission, link: Link, run: Path, *, lockstep: bool) -> None:
    """Simulate the world of ``mission``, or what its cameras see where autopilots fly; what is true of it is left in
    the run folder."""
    photographer, lidar, contacts = await asyncio.to_thread(_make_sensors, mission, run)
    with MetricsEndpoint(mission, "sim"):
        async with connect(link, mission.name, lossless=lockstep) as bus:
            if mission.vehicles.kind == "px4":
                await Observer(mission, bus, photographer).run()
            else:
                await Simulator(mission, bus, photographer, lidar, contacts, lockstep=lockstep).run()


def _make_sensors(mission: Mission, run: Path) -> tuple[Photographer | None, LidarSensor | None, Contacts | None]:
    """Load the scene, leave its truth in the run folder, and warm the camera up; None for a mission without a scene, or
    without a lidar."""
    if not mission.simulation.scene:
        return None, None, None
    # Heavy modules that a simulator without a scene does not need.
    from sim_bridge.camera import Camera
    from sim_bridge.contacts import Contacts
    from sim_bridge.photographer import Photographer
    from sim_bridge.scenes.cache import scene_cache
    from sim_bridge.scenes.scene import load_scene
    from sim_bridge.scenes.truth import write_truth

    cache = scene_cache()
    simulation = mission.simulation
    scene = load_scene(
        simulation.scene,
        relative_to=run,
        cache=cache,
        texture_contrast=simulation.texture_contrast,
        on_progress=log.info,
    )
    write_truth(scene, mission, run, cache=cache)
    camera = Camera(scene, mission.camera.intrinsics())
    camera.render(mission.drones[0].start)
    depth_camera = Camera(scene, mission.sweep_intrinsics()) if mission.measures_depth else None
    photographer, contacts = Photographer(mission, camera, depth_camera), Contacts(mission, scene.triangles)
    contacts.rehearse(np.array(mission.drones[0].start))
    if mission.localization.source != "lidar":
        return photographer, None, contacts
    from sim_bridge.lidar import LidarSensor

    return photographer, LidarSensor(scene, mission.lidar, mission.seed), contacts
