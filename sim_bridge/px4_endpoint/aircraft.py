"""One vehicle without its link: what PX4 and the airframe do from step to step. Time is given, nothing is sent.

What loses its power when a battery is changed begins anew in `Aircraft._boot`; what does not, it keeps: the airframe,
its place, and PX4's parameters.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from protocol.mission import Drone, Mission
from sim_bridge.px4_endpoint.battery import Battery
from sim_bridge.px4_endpoint.body import Body, Wind
from sim_bridge.px4_endpoint.commander import Commander, Situation
from sim_bridge.px4_endpoint.estimator import Estimator
from sim_bridge.px4_endpoint.frames import Geodetic, Vector, ned, unproject, world_yaw
from sim_bridge.px4_endpoint.gimbal import Gimbal
from sim_bridge.px4_endpoint.guidance import Estimate, Guidance, Target
from sim_bridge.px4_endpoint.modes import Mode
from sim_bridge.px4_endpoint.parameters import Parameters
from sim_bridge.px4_endpoint.takeoff import Ground

Pose: TypeAlias = tuple[float, float, float, float, float]

HOME: Geodetic = (47.397742, 8.545594, 488.0)
"""Origin of a world that says none: where PX4's own simulation stands."""
KNOWS_BATTERY_S = 2.0
"""After booting, until the share of the battery is known."""
EV_HORIZONTAL, EV_VERTICAL = 1, 2
"""Bits of EKF2_EV_CTRL."""
VISION_LOST_S = 5.0
"""PX4's EKF2_NOAID_TOUT."""
LIFTING = (Mode.TAKEOFF, Mode.OFFBOARD, Mode.MANUAL, Mode.ALTCTL, Mode.POSCTL, Mode.STABILISED)
"""Modes that may leave the ground."""


class Aircraft:
    """Stands at z = 0 below its start; its local frame has its origin there, or in the world's when the mission has no
    ``vehicles.origin``."""

    def __init__(self, mission: Mission, drone: Drone) -> None:
        self._dice = dice = np.random.default_rng([mission.seed, drone.id])
        settings = mission.autopilot
        x, y, _, yaw, pitch = drone.start
        self._settings, self._world = settings, mission.vehicles.origin
        self.parameters = Parameters()
        self.parameters.set("MAV_SYS_ID", drone.mavlink_system)
        if not settings.satellites:
            self.parameters.set("EKF2_GPS_CTRL", 0)
        self.wind = Wind(settings, dice)
        self.body = Body(ned((x, y, 0.0)), world_yaw(yaw))
        self.battery = Battery(settings.battery_s, mission.vehicles.battery_swap_s, mission.vehicles.battery_spares)
        self.gimbal = Gimbal(self.parameters, settings.gimbal_rate_max_radps)
        self.faults: tuple[str, ...] = ()
        """Red checks that were put into it."""
        self.power_off_s = settings.power_off_s
        """How long changing the battery takes its power."""
        self.tells_battery = True
        """Whether the share of the battery is known."""
        self.boots = 0
        """How often it has begun anew."""
        self.booted_s = 0.0
        """Its time begins here; at first with the machine's, so that stamps of all vehicles compare."""
        self.boot_error: Vector = (0.0, 0.0, 0.0)
        """How far off its estimate begins after the next boot: north, east, down."""
        self.now_s = 0.0
        self._flight = mission.flight
        self._fixed_pitch = pitch if mission.vehicles.camera_mount == "fixed" else None
        self._push_until_s = self._off_until_s = -math.inf
        self._boot()

    def _boot(self) -> None:
        """The autopilot begins: with a local frame of its own where it stands, but where all share one."""
        here = self.body.position
        origin = here if self._world else (0.0, 0.0, 0.0)
        self.commander = Commander(self.parameters)
        self.guidance = Guidance(self.parameters)
        self.guidance.home = (here[0] - origin[0], here[1] - origin[1], here[2] - origin[2])
        self.ground = Ground(self.parameters, self._settings.spool_up_s)
        self.estimator = Estimator(origin, self._settings.position_noise_m, self._dice, self._settings.drift_mps)
        self.origin: Geodetic = unproject(self._world or HOME, origin)
        """Of the local frame: GPS_GLOBAL_ORIGIN."""
        self.commanded: Vector = (0.0, 0.0, 0.0)
        self._setpoint_s = -math.inf
        self._mode = self.commander.mode
        self._armed = False
        self._seen_s = -math.inf
        self._resets = 0

    @property
    def is_off(self) -> bool:
        """Whether it has no power."""
        return self.now_s < self._off_until_s

    @property
    def up_s(self) -> float:
        """Its own time."""
        return self.now_s - self.booted_s

    @property
    def knows_battery(self) -> bool:
        return self.tells_battery and (self.boots == 0 or self.up_s > KNOWS_BATTERY_S)

    @property
    def has_position(self) -> bool:
        """Whether anything tells it: satellites, or external vision within the last seconds."""
        return self.parameters["EKF2_GPS_CTRL"] > 0 or self.now_s - self._seen_s < VISION_LOST_S

    @property
    def red(self) -> tuple[str, ...]:
        """All red checks, by what PX4 calls them."""
        return self.faults if self.has_position else (*self.faults, "No valid local position estimate")

    @property
    def estimate(self) -> Estimate:
        body, estimator = self.body, self.estimator
        v, push = body.velocity, body.push
        moving = (v[0] + push[0], v[1] + push[1], v[2] + push[2])
        return Estimate(estimator.position(body.position), estimator.velocity(moving), body.yaw)

    @property
    def situation(self) -> Situation:
        here = self.estimate
        return Situation(
            self.now_s,
            self.now_s - self._setpoint_s < self.parameters["COM_OF_LOSS_T"],
            self.ground.landed,
            self.red,
            self.battery.share,
            self._outside_fence(here.position),
            self.guidance.took_off(here),
        )

    @property
    def pose(self) -> Pose:
        """Where the camera truly is: x, y, z, yaw, depression; world frame."""
        x, y, z = ned(self.body.position)
        if self._fixed_pitch is not None:
            return (x, y, z, world_yaw(self.body.yaw), self._fixed_pitch - self.body.pitch)
        return (x, y, z, world_yaw(self.body.yaw + self.gimbal.yaw.angle), -self.gimbal.pitch.angle)

    def aim(self, target: Target, now_s: float) -> None:
        """An offboard setpoint arrived."""
        self.guidance.target = target
        self._setpoint_s = now_s

    def see(self, position: Vector, resets: int, now_s: float) -> None:
        """Where external vision saw the vehicle EKF2_EV_DELAY ago, local north, east, down: EKF2_EV_CTRL says of which
        axes it is believed. The yaw is never off here."""
        control = int(self.parameters["EKF2_EV_CTRL"])
        here, late_s = self.estimate, self.parameters["EKF2_EV_DELAY"] / 1e3
        axes = control & EV_HORIZONTAL, control & EV_HORIZONTAL, control & EV_VERTICAL
        n, e, d = (
            seen - (own - late_s * speed) if fused else 0.0
            for seen, own, speed, fused in zip(position, here.position, here.velocity, axes, strict=True)
        )
        if any(axes):
            reset = not self.has_position or resets != self._resets
            self.estimator.correct((n, e, d), now_s, reset=reset)
            self._seen_s, self._resets = now_s, resets

    def jump(self, by: Vector) -> None:
        """The estimate moves at once by north, east, down; the vehicle does not."""
        self.estimator.jump(by)
        self.guidance.shift(by)

    def push(self, velocity: Vector, seconds: float) -> None:
        """Carry it along with this velocity, north, east, down, on top of what it flies."""
        self.body.push = velocity
        self._push_until_s = self.now_s + seconds

    def step(self, now_s: float, dt: float) -> None:
        """Advance by ``dt`` seconds to ``now_s``."""
        was_off, self.now_s = self.is_off, now_s
        if was_off:
            if not self.is_off:
                self._boot_again()
            return
        if now_s > self._push_until_s:
            self.body.push = (0.0, 0.0, 0.0)
        self.wind.step(dt)
        self.estimator.step(dt)
        commander = self.commander
        commander.step(self.situation)
        self._follow_commander()
        if commander.armed:
            self.battery.drain(dt)
            self._fly(now_s, dt)
        else:
            self.ground.step(now_s, dt, armed_s=None, on_ground=self.body.on_ground, wanted_down=0.0)
            self.body.rest(dt)
            if self.ground.landed and self.battery.stand(dt):
                self._off_until_s = now_s + self.power_off_s
        self.gimbal.step(self.body.yaw, dt)

    def _boot_again(self) -> None:
        self.boots, self.booted_s = self.boots + 1, self.now_s
        self.gimbal.release()
        self._boot()
        self.jump(self.boot_error)

    def _follow_commander(self) -> None:
        armed, mode = self.commander.armed, self.commander.mode
        if armed and not self._armed:
            self.guidance.home = self.estimate.position
        if mode is not self._mode or armed is not self._armed:
            self.guidance.enter(mode, self.estimate)
        self._mode, self._armed = mode, armed

    def _fly(self, now_s: float, dt: float) -> None:
        velocity, yaw_rate = self.guidance.command(self._mode, self.estimate)
        down = velocity[2] if self.ground.airborne or self._mode in LIFTING else 0.0
        climb = self.ground.step(
            now_s, dt, armed_s=self.commander.armed_s, on_ground=self.body.on_ground, wanted_down=down
        )
        self.commanded = (velocity[0], velocity[1], max(down, -climb))
        if not self.ground.airborne:
            self.body.rest(dt)
            return
        error = self.estimator.velocity_error  # the controller sees the estimate, so its error is flown
        n, e, d = self.commanded
        self.body.fly((n - error[0], e - error[1], d - error[2]), yaw_rate, self.wind, self._flight, dt)

    def _outside_fence(self, position: Vector) -> bool:
        home, parameters = self.guidance.home, self.parameters
        wide, high = parameters["GF_MAX_HOR_DIST"], parameters["GF_MAX_VER_DIST"]
        far = math.hypot(position[0] - home[0], position[1] - home[1])
        return (wide > 0 and far > wide) or (high > 0 and home[2] - position[2] > high)
