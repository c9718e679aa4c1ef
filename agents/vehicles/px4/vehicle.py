"""Any PX4 vehicle behind the `Vehicle` protocol: hardware, PX4 SITL, or our endpoint.

Setpoints and getters go straight to MAVSDK, commands through an executor of its own: the event loop's default one is
shared, and commands that nobody answers would keep setpoints waiting in it for seconds.
"""

from __future__ import annotations

import asyncio
import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from mavsdk import System

from agents.vehicles.px4 import frames
from agents.vehicles.px4.authority import FAILSAFES, AuthorityLogic, Observation, Step
from agents.vehicles.px4.connection import Connection
from agents.vehicles.px4.external_pose import ExternalPoseLink
from agents.vehicles.px4.gimbal import Aim, GimbalWatch
from agents.vehicles.px4.pilot import Pilot
from agents.vehicles.px4.preparation import Preparation, Prepared, UntilTooLate, prepare_vehicle
from agents.vehicles.px4.recheck import Recheck
from agents.vehicles.px4.setpoint import AngleSetpoint, yaw_setpoint
from agents.vehicles.px4.telemetry_slots import TelemetrySlots
from agents.vehicles.vehicle import Condition, SeenPose, Telemetry
from protocol.errors import VehicleError
from protocol.geometry import Floats
from protocol.mission import Mission

COMMANDS_AT_ONCE = 2
IDLE_PERIOD_S = 0.5
"""MAVSDK stops repeating setpoints after three seconds in another mode; this starts it again."""
LATE_TICKS = 2.0
"""An angle's setpoint moves by the time since the last one, but by no more ticks than this."""
LEAD_ERRORS = 2.0
"""A gimbal's setpoint runs at most so many ``gimbal_error_rad`` ahead: enough to see that it does not follow."""
STILL: Floats = np.zeros(3)


class Px4Vehicle:
    """``prepare`` first; `stop`, `hold` and `land` from any thread afterwards, and the rest in the event loop."""

    def __init__(
        self,
        mission: Mission,
        drone: int,
        *,
        now_s: Callable[[], float],
        events: Callable[[str, str], None],
    ) -> None:
        """``now_s``: monotonic, callable from any thread; ``events``: called in the event loop with a level ("debug" to
        "emergency", as MAVLink's status texts) and a text."""
        self._mission, self._drone, self._now_s, self._events = mission, drone, now_s, events
        self._settings, self._start = mission.vehicles, mission.drone(drone).start
        self._limit = np.array(mission.flight.velocity_limits)
        self._lock = threading.Lock()
        self._logic = AuthorityLogic(self._start[2], mission.vehicles.telemetry_lost_s)
        self._executor = ThreadPoolExecutor(COMMANDS_AT_ONCE, thread_name_prefix=f"px4-{drone}")
        self._slots = TelemetrySlots(
            now_s, self._tell, math.hypot(*mission.flight.velocity_limits[:3]), mission.vehicles.jump_m
        )
        self._connection: Connection | None = None
        self._prepared: Prepared | None = None
        self._again: Recheck | None = None
        self._silences = 0
        """Of those on the ground, how many were noticed."""
        self._stood: Telemetry | None = None
        """The newest from before such a silence, until its place has been asked for anew."""
        self._external: ExternalPoseLink | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._loop_thread = 0
        self._pilot: asyncio.Task[None] | None = None
        self._yaw = yaw_setpoint(mission.flight.turn_rate_max_radps)
        """World yaw: of the vehicle, or of a gimbal that yaws."""
        lead_rad = LEAD_ERRORS * mission.vehicles.gimbal_error_rad
        self._pitch = AngleSetpoint(lead_rad, mission.flight.pitch_limits_rad)
        self._heading_rad = 0.0
        """World yaw that a vehicle keeps while its gimbal yaws."""
        self._watch = GimbalWatch(mission.vehicles.gimbal_error_rad, mission.vehicles.gimbal_lost_s)
        self._sent_s = self._idled_s = -math.inf
        self._sent_rates = (0.0, 0.0)

    # Before the flight

    async def prepare(self) -> None:
        self._loop, self._loop_thread = asyncio.get_running_loop(), threading.get_ident()
        try:
            system = await self._connect()
            if self._mission.localization.source == "mocap":
                self._external = ExternalPoseLink(system, self._now_s)
            preparation = Preparation(system, self._slots, self._mission, self._drone, self._external)
            patience = UntilTooLate(self._mission, self._drone, self._now_s)
            self._prepared = await prepare_vehicle(preparation, self._executor, self._now_s, self._events, patience)
            self._again = Recheck(preparation, self._executor, self._now_s, self._events)
            self._begin(self._prepared)
        except BaseException:
            self.close()
            raise

    async def _connect(self) -> System:
        drone = self._mission.drone(self._drone)
        owner = f"drone {drone.id} of mission {self._mission.name!r}"
        url = self._mission.vehicle_url(drone)
        self._connection = Connection(url, drone.mavlink_system, owner)
        await asyncio.get_running_loop().run_in_executor(self._executor, self._connection.open)
        return await self._connection.discover(self._settings.discovery_s, self._now_s)

    def _begin(self, prepared: Prepared) -> None:
        self._logic = AuthorityLogic(
            self._start[2], self._settings.telemetry_lost_s, FAILSAFES.get(prepared.loss_action, "")
        )
        self._logic.observe(self.observe(), self._now_s())
        self._start_from(prepared)
        pilot = Pilot(self, self._logic, self._lock, self._executor, self._now_s, self._events)
        self._pilot = asyncio.get_running_loop().create_task(pilot.run(), name=f"pilot of drone {self._drone}")

    def _start_from(self, prepared: Prepared) -> None:
        if prepared.aim is not None:
            self._pitch.reset(prepared.aim.pitch_rad)
        self._take_measured_yaw()

    def take_off(self) -> None:
        with self._lock:
            self._logic.take_off(self._now_s())

    def make_ready(self) -> bool:
        if self._again is None or self._again.is_running or self._logic.phase != "landed":
            return False
        if not self._again.is_fit:
            self._again.begin()
            return False
        with self._lock:
            return self._logic.make_ready(self._now_s())

    def aid(self, seen: SeenPose) -> None:
        """Once it is connected; in the event loop."""
        if self._external is not None:
            self._external.send(seen)

    # What it says

    def condition(self) -> Condition:
        """Raises: VehicleError: the pilot task or a check failed."""
        if self._again is not None and self._again.error is not None:
            raise VehicleError(f"drone {self._drone}: it cannot be checked again: {self._again.error}")
        if self._pilot is not None and self._pilot.done() and not self._pilot.cancelled():
            error = self._pilot.exception()
            if error is not None:
                raise VehicleError(f"drone {self._drone}: its pilot task failed: {error}") from error
        with self._lock:
            authority, reason = self._logic.authority, self._logic.reason
        return Condition(authority, reason, self._watch.lost, self._slots.jumps)

    def telemetry(self) -> Telemetry | None:
        if self._stood is not None:
            return self._stood
        motion, attitude, battery = self._slots.motion, self._slots.attitude, self._slots.battery
        if self._prepared is None or motion is None or attitude is None or battery is None:
            return None
        tilt = attitude.value
        pose, velocity, rotation = np.empty(5), np.empty(5), None
        pose[:3] = self._prepared.frame.to_world(motion.value.position)
        pose[3:] = self._camera_angles(frames.world_yaw(tilt.yaw_rad))
        velocity[:3] = frames.world_vector(motion.value.velocity)
        velocity[3:] = self._camera_rates(tilt.roll_rad, tilt.pitch_rad)
        if self._settings.camera_mount == "fixed":
            rotation = frames.fixed_camera_rotation(tilt.roll_rad, tilt.pitch_rad, tilt.yaw_rad, self._start[4])
        return Telemetry(pose, velocity, battery.value, min(motion.at_s, attitude.at_s), rotation=rotation)

    def _camera_angles(self, heading_rad: float) -> tuple[float, float]:
        pointing = self._slots.pointing
        if self._settings.camera_mount == "fixed" or pointing is None:
            return heading_rad, self._start[4]
        yaw_rad = heading_rad
        if self._settings.camera_mount == "gimbal":
            yaw_rad = frames.world_yaw(pointing.value.yaw_rad)
        return yaw_rad, -pointing.value.pitch_rad

    def _camera_rates(self, roll_rad: float, pitch_rad: float) -> tuple[float, float]:
        """Gimbals seldom tell their rates: those that were sent last."""
        rates = self._slots.body_rates
        if self._settings.camera_mount == "gimbal" or rates is None:
            return self._sent_rates
        _, q, r = rates.value.tolist()
        return frames.turn_rate(roll_rad, pitch_rad, q, r), self._sent_rates[1]

    # Setpoints

    def send(self, tick: int, velocity: Floats) -> Floats:  # noqa: ARG002  # the protocol's; PX4 flies what came last
        """Zeros while the vehicle is not ours; nothing is sent then.

        Raises:
            VehicleError: the connection is gone.
        """
        now_s, sent = self._now_s(), np.zeros(5)
        prepared, attitude = self._prepared, self._slots.attitude
        with self._lock:
            if not self._logic.sent(now_s) or prepared is None or attitude is None:
                return sent
            wished = np.clip(velocity, -self._limit, self._limit)
            sent[:3] = wished[:3]
            elapsed_s = min(now_s - self._sent_s, LATE_TICKS * self._mission.tick_s)
            if elapsed_s > 0:
                measured_yaw, measured_pitch = self._camera_angles(frames.world_yaw(attitude.value.yaw_rad))
                sent[3] = self._yaw.advance(float(wished[3]), elapsed_s, measured_yaw)
                if self._settings.camera_mount != "fixed":
                    sent[4] = self._pitch.advance(float(wished[4]), elapsed_s, measured_pitch)
            self._sent_s, self._sent_rates = now_s, (float(sent[3]), float(sent[4]))
            self._put(prepared, frames.ned_vector(sent[:3]))
        return sent

    def pass_tick(self, tick: int) -> None:
        """Nothing: nobody waits for it."""

    def stop(self) -> None:
        """Nothing is sent while the vehicle is not ours."""
        with self._lock:
            if self._prepared is not None and self._logic.authority == "ours":
                self._put(self._prepared, STILL)

    def _put(self, prepared: Prepared, velocity_ned: Floats) -> None:
        """Needs the lock."""
        yaw_rad = self._heading_rad if self._settings.camera_mount == "gimbal" else self._yaw.angle_rad
        prepared.commands.fly(velocity_ned, frames.ned_yaw(yaw_rad or 0.0))
        aim = self._aim()
        if prepared.gimbal is not None and aim is not None:
            prepared.gimbal.point(aim)

    def _aim(self) -> Aim | None:
        if self._settings.camera_mount == "fixed" or self._pitch.angle_rad is None:
            return None
        return Aim(self._pitch.angle_rad, self._yaw.angle_rad if self._settings.camera_mount == "gimbal" else None)

    def _take_measured_yaw(self) -> None:
        """From here on the vehicle turns only where it is told to."""
        attitude = self._slots.attitude
        if attitude is not None:
            self._heading_rad = frames.world_yaw(attitude.value.yaw_rad)
            if self._settings.camera_mount != "gimbal":
                self._yaw.reset(self._heading_rad)
        aim = None if self._prepared is None else self._prepared.aim
        if self._yaw.angle_rad is None and aim is not None and aim.yaw_rad is not None:
            self._yaw.reset(aim.yaw_rad)

    # Orders

    def hold(self) -> None:
        """From the event loop, the pilot task gives the order; from another thread it is given here and now."""
        self._order("hold", direct=not self._is_in_loop)

    def land(self) -> None:
        """Likewise."""
        self._order("land", direct=not self._is_in_loop)

    def _order(self, step: Step, *, direct: bool) -> None:
        """Raises: VehicleError: given here, and refused or not answered; the pilot task goes on trying."""
        with self._lock:
            prepared = self._prepared
            if prepared is None:
                return
            tell = self._logic.hold(direct=direct) if step == "hold" else self._logic.land(direct=direct)
            if not tell:
                return
        refusal = ""
        try:
            with self._lock:
                self._sent_rates = (0.0, 0.0)
                self._put(prepared, STILL)
            if direct:
                prepared.commands.give(step)
        except VehicleError as error:
            refusal = str(error)
            raise
        finally:
            if direct:
                with self._lock:
                    self._logic.answered(step, self._now_s(), refusal)

    def leave(self, *, hold: bool) -> None:
        """A vehicle that has not left the ground is disarmed. A refusal becomes an event: what made the control task
        end must not be hidden by it."""
        try:
            if self._prepared is not None and self._logic.phase == "climbing" and self.observe().on_ground:
                self._prepared.commands.give("disarm")
            step: Step = "hold" if hold else "land"
            flies = self._logic.authority in ("starting", "ours")
            self._order(step, direct=True)
            if flies:
                self._tell("info", f"the control task ends: told to {step}")
        except VehicleError as error:
            self._tell("error", f"left to itself: {error}")

    def close(self) -> None:
        self._prepared = self._external = None
        if self._pilot is not None:
            self._pilot.cancel()
        if self._again is not None:
            self._again.cancel()
        self._slots.unsubscribe()
        self._executor.shutdown(wait=True, cancel_futures=True)
        if self._connection is not None:
            self._connection.close()

    # The pilot's cockpit

    def observe(self) -> Observation:
        slots, prepared = self._slots, self._prepared
        motion, mode, armed, landed, connected = slots.motion, slots.mode, slots.armed, slots.landed, slots.connected
        if prepared is None or motion is None or mode is None or armed is None or landed is None:
            raise VehicleError(f"drone {self._drone}: not prepared")
        return Observation(
            mode=mode.value,
            mode_at_s=mode.at_s,
            armed=armed.value,
            on_ground=landed.value == "ON_GROUND",
            height_m=float(prepared.frame.to_world(motion.value.position)[2]),
            heard_s=max(sample.at_s for sample in (motion, mode, slots.attitude or motion)),
            connected=connected is None or connected.value,
        )

    def command(self, step: Step) -> None:
        if self._prepared is not None:
            self._prepared.commands.give(step)

    def idle(self) -> None:
        """Stream zero velocity and the yaw that it has."""
        now_s = self._now_s()
        if self._prepared is not None and now_s - self._idled_s >= IDLE_PERIOD_S:
            self._idled_s = now_s
            with self._lock:
                self._take_measured_yaw()
                self._sent_s, self._sent_rates = -math.inf, (0.0, 0.0)
                self._put(self._prepared, STILL)

    def watch(self) -> None:
        """Judge the gimbal, and what was silent on the ground."""
        self._look_again()
        if self._settings.camera_mount == "fixed":
            return
        was = self._watch.lost
        flies = self._logic.phase in ("climbing", "entering", "ours", "held")
        self._watch.judge(self._aim() if flies else None, self._slots.pointing, self._now_s())
        if self._watch.lost != was:
            self._events(*(("error", f"gimbal lost: {self._watch.reason}") if not was else ("info", "gimbal is back")))

    def _look_again(self) -> None:
        """What was without power has another local frame: nothing that it says of its place counts until then."""
        if self._again is None:
            return
        if self._logic.silences > self._silences:
            self._stood, self._silences = self.telemetry(), self._logic.silences
            self._events("warning", "silent on the ground: is checked again when it is heard")
            self._again.begin()
        prepared = self._again.take()
        if prepared is not None:
            with self._lock:
                self._prepared, self._stood = prepared, None
                self._start_from(prepared)

    @property
    def _is_in_loop(self) -> bool:
        return threading.get_ident() == self._loop_thread

    def _tell(self, level: str, text: str) -> None:
        """From any thread."""
        if self._is_in_loop:
            self._events(level, text)
        elif self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._events, level, text)
