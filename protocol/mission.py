"""What is to be flown: the one place where every setting, its unit, its default and the default's source live.

A mission is written as TOML (`protocol.mission_file`). Keys carry their unit; "paper" means
the simulation section of "Coverage-Recon: Coordinated Multi-Drone Image Sampling with Online Map Feedback", eq. numbers
are that paper's, and departures from it are listed in ARCHITECTURE.md.
"""

from __future__ import annotations

import math
import re
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from protocol.battery_settings import Battery, battery_faults
from protocol.geometry import Intrinsics
from protocol.localization_settings import CaptureNoise, EstimateNoise, Lidar, Localization, Mocap
from protocol.map_settings import Camera, Feedback, Reconstruction
from protocol.obstacle_settings import Obstacles
from protocol.operation_settings import Console, Metrics, Recording
from protocol.planner_settings import PlannerName, Planners, planner_faults
from protocol.separation import widened_separation
from protocol.settings import Angle, Metres, NonNegative, Positive, Settings, Share, Vector
from protocol.transport_settings import Transport
from protocol.vehicle_settings import Autopilot, Vehicles
from protocol.zone_settings import ZONES_MAX, NoFly, Polygon


class Box(Settings):
    lower_m: Vector
    """Smallest x, y, z, world frame."""
    upper_m: Vector
    """Largest x, y, z, world frame."""

    @model_validator(mode="after")
    def _has_volume(self) -> Self:
        if any(low >= high for low, high in zip(self.lower_m, self.upper_m, strict=True)):
            raise ValueError(f"upper_m {self.upper_m} must exceed lower_m {self.lower_m} on every axis")
        return self

    def contains(self, point: tuple[float, ...]) -> bool:
        bounds = zip(self.lower_m, point, self.upper_m, strict=False)
        return all(low <= value <= high for low, value, high in bounds)


class Target(Box):
    """B x view angles: the cells that are to be seen (paper: 117,600 of them)."""

    lower_m: Vector = (-3.0, -3.0, 0.0)
    upper_m: Vector = (3.0, 3.0, 2.0)
    cell_m: Positive = 0.3
    """Wished edge of a cell; the lattice uses the nearest size that divides B evenly."""
    yaw_rad: tuple[Angle, Angle] = (-math.pi, math.pi)
    """Range of the direction from which a cell is seen."""
    pitch_rad: tuple[Angle, Angle] = (math.pi / 3, math.pi / 2)
    """Its elevation, from the cell up towards the camera; pi/2 is from straight above."""
    cell_rad: Positive = 0.3

    @model_validator(mode="after")
    def _angles_ascend(self) -> Self:
        for name in ("yaw_rad", "pitch_rad"):
            low, high = getattr(self, name)
            if low >= high:
                raise ValueError(f"{name} must be [smaller, larger], got [{low}, {high}]")
        return self


class Sensing(Settings):
    """h1 of eq. (1) and the decay of eq. (2)."""

    distance_m: Positive = 1.0
    """D, the best distance from which to see a cell (paper)."""
    sigma_axis: Positive = 0.07
    """sigma_1: tolerance of 1 - cos(angle between optical axis and line of sight)."""
    sigma_view: Positive = 0.095
    """sigma_2: tolerance of 1 - cos(angle between wished and actual view direction). Departure 5."""
    sigma_distance_m: Positive = 0.3
    """sigma_3: tolerance of the distance."""
    decay_per_s: Positive = 3.0
    """delta_1."""
    exponent_cut: Annotated[float, Field(gt=0, le=80)] = 12.0
    """Cells with h1 < exp(-exponent_cut) are left alone; J(t) was the same to the tick from 12 to 300."""


class Flight(Box):
    """Where and how the drones may fly. The paper does not state input bounds; these are ours."""

    lower_m: Vector = (-4.0, -4.0, 0.5)
    upper_m: Vector = (4.0, 4.0, 5.0)
    boundary: Polygon | None = None
    """[[x, y], ...] within the box, which drones do not leave at any height; left out: the box alone. docs/zones.md."""
    no_fly: Annotated[tuple[NoFly, ...], Field(max_length=ZONES_MAX)] = ()
    """What nobody enters."""
    obstacles: Obstacles = Obstacles()
    clearance_m: Positive = 0.3
    """Distance of a drone's centre from boundary and zones: its radius, and what you want beside it; position_error_m
    and what lag adds come on top. The box itself is kept by the centre."""
    separation_m: Positive = 1.0
    """d: distance that any two drones keep, centre to centre."""
    position_error_m: NonNegative = 0.0
    """How far a vehicle's estimate of its position may be off; by their estimates two drones keep d and twice this."""
    speed_max_mps: Positive = 0.5
    """Bound of each velocity component."""
    turn_rate_max_radps: Positive = 0.5
    """Bound of the camera's yaw and pitch rates."""
    gimbal_rate_max_radps: Positive | None = None
    """Bound of the pitch rate alone, where the gimbal is slower or faster than the vehicle turns; left out:
    turn_rate_max_radps."""
    acceleration_max_mps2: Positive = 4.0
    """What the vehicle can do, each axis; with response_time_s it bounds the change of a commanded velocity."""
    angular_acceleration_max_radps2: Positive = 8.0
    jerk_max_mps3: NonNegative = 0.0
    """How fast commands may change the acceleration on each axis; 0: no bound. It is exceeded where a drone would break
    a strict row otherwise. docs/smooth-flight.md."""
    angular_jerk_max_radps3: NonNegative = 0.0
    """Likewise of yaw and pitch."""
    response_time_s: NonNegative = 0.15
    """First-order lag from commanded to flown velocity; the barriers look ahead by it."""
    pitch_limits_rad: tuple[Angle, Angle] = (math.pi / 3, math.pi / 2)
    """Range of the gimbal's depression angle."""
    setpoint_timeout_s: Positive = 0.5
    """A vehicle whose setpoints stop for so long is braked, whatever the control task does."""

    @property
    def estimated_separation_m(self) -> float:
        """What two estimates must keep so that the vehicles keep ``separation_m``."""
        return self.separation_m + 2 * self.position_error_m

    @property
    def has_zones(self) -> bool:
        return self.boundary is not None or bool(self.no_fly)

    @property
    def velocity_limits(self) -> tuple[float, float, float, float, float]:
        """Largest x, y, z, yaw and pitch rate, m/s and rad/s."""
        return (self.speed_max_mps,) * 3 + (self.turn_rate_max_radps, self.pitch_rate_max_radps)

    @property
    def pitch_rate_max_radps(self) -> float:
        return self.turn_rate_max_radps if self.gimbal_rate_max_radps is None else self.gimbal_rate_max_radps

    @property
    def acceleration_limits(self) -> tuple[float, float, float, float, float]:
        """Likewise of the accelerations."""
        return (self.acceleration_max_mps2,) * 3 + (self.angular_acceleration_max_radps2,) * 2

    @property
    def jerk_limits(self) -> tuple[float, float, float, float, float]:
        """Likewise of the jerk, infinite where there is no bound."""
        return (self.jerk_max_mps3 or math.inf,) * 3 + (self.angular_jerk_max_radps3 or math.inf,) * 2

    @model_validator(mode="after")
    def _limits_ascend(self) -> Self:
        low, high = self.pitch_limits_rad
        if not -math.pi / 2 <= low < high <= math.pi / 2:
            raise ValueError(f"pitch_limits_rad must ascend within [-pi/2, pi/2], got [{low}, {high}]")
        return self

    @model_validator(mode="after")
    def _zones_leave_room(self) -> Self:
        if self.has_zones:
            from protocol.free_space import zone_faults  # numba and SciPy's images: 0.3 s for every process that starts

            faults = zone_faults(self)
            if faults:
                raise ValueError("\n".join(faults))
        return self

    @model_validator(mode="after")
    def _can_brake_at_once(self) -> Self:
        """Otherwise a drone could not command zero velocity without leaving the model its barriers rest on."""
        for acceleration, speed in (
            ("acceleration_max_mps2", "speed_max_mps"),
            ("angular_acceleration_max_radps2", "turn_rate_max_radps"),
            ("angular_acceleration_max_radps2", "gimbal_rate_max_radps"),
        ):
            reach = getattr(self, acceleration) * self.response_time_s
            if 0 < reach < (getattr(self, speed) or 0):
                raise ValueError(f"{acceleration} x response_time_s, {reach:g}, must be at least {speed}")
        return self

    @model_validator(mode="after")
    def _jerk_needs_a_lag(self) -> Self:
        for jerk in ("jerk_max_mps3", "angular_jerk_max_radps3"):
            if getattr(self, jerk) > 0 and self.response_time_s == 0:
                raise ValueError(f"{jerk} needs response_time_s: without a lag there is no acceleration to bound")
        return self


class Controller(Settings):
    """The QP of one drone."""

    planner: PlannerName = "coverage"
    """"coverage" is the paper's; the others are those it compares with, in ``planners``."""
    rate_hz: Positive = 20.0
    """Ticks a second of the whole mission, not of the controller alone (paper)."""
    effort_weight: Positive = 0.01
    """epsilon."""
    smoothing: NonNegative = 0.0
    """Of planner "coverage": weight of speed and acceleration against what is seen; 0 as in the paper, at 0.1 a
    quarter less acceleration and blur, and 3 to 10 % more time. docs/smooth-flight.md."""
    coverage_rate_per_s: Positive = 0.012
    """gamma: wished mean decay of a drone's own cells."""
    sampling_gain_per_s: Positive = 1.0
    """a1."""
    pitch_gain_per_s: Positive = 1.0
    """a2."""
    separation_gain_per_s: Positive = 1.0
    """a3; the region rows use it too."""


class Simulation(Settings):
    scene: str = "living_room"
    """A built-in scene's name, or the path of a glb, gltf, obj, ply or stl file or of a folder that holds one, relative
    to the mission file; empty for a flight without images."""
    texture_contrast: Share = 1.0
    """Factor on how far each texture's texels differ from its mean colour: 1 as drawn, 0 plain colours under the same
    light."""
    exposure_s: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    """How long the shutter is open: images blur along the camera's motion meanwhile; 0: not at all."""
    image_noise: NonNegative = 2.0
    """Standard deviation of the camera's noise, in grey levels of 255."""
    depth_noise_m: NonNegative = 0.002
    """Of a depth camera: standard deviation of a depth close by, ..."""
    depth_noise_per_m: NonNegative = 0.003
    """... and what is added to it for each square metre of the depth's square, 1/m: stereo and structured light."""
    pose_noise_m: NonNegative = 0.0
    """Standard deviation, on each axis, of the error of the position that is sent with a keyframe ..."""
    pose_noise_rad: NonNegative = 0.0
    """... and of its attitude. Independent from frame to frame; how the vehicles fly does not change."""
    estimate: EstimateNoise = EstimateNoise()
    mocap: CaptureNoise = CaptureNoise()
    battery: Battery = Battery()
    vehicle_radius_m: Positive = 0.15
    """Of the sphere that a vehicle is: where it touches the scene, that is counted."""
    start_patience_s: Positive = 120.0
    """How long the first tick waits for all drones; one that comes later joins in flight."""


class Replication(Settings):
    """How phi stays equal in all processes, and what happens without the ground station."""

    wait_s: Positive = 0.5
    """In real time, how long a tick's integration waits for a state or a jump that is missing; then it is left out.
    So it bounds the age of every replica's phi."""
    digest_period_s: Positive = 1.0
    """Between two digests of the ground station's phi, against which the others compare theirs."""
    tolerance: Positive = 1e-5
    """Root mean square difference of a block's cells from which it is fetched: above what float32 rounding of unlike
    processors adds up to, and a lost state makes about 1e-3."""
    checkpoint_period_s: Positive = 20.0
    """Mission time between two checkpoints of the ground station: of map and record, so much a kill -9 may cost."""
    journal_limit_mb: Positive = 64.0
    """From this size on, jumps that a checkpoint holds are removed from the journal."""
    ground_patience_s: Positive = 60.0
    """How long agents go on covering without the ground station ..."""
    ground_lost: Literal["hold", "land"] = "hold"
    """... and what they do then, until it is back."""


class Drone(Settings):
    id: Annotated[int, Field(ge=1, le=255)]
    start: tuple[Metres, Metres, Metres, Angle, Angle]
    """x, y, z in metres, yaw, pitch (depression) in radians. A vehicle that takes off stands below and climbs to z."""
    url: str = ""
    """MAVSDK connection of this drone's vehicle; empty: counted up from ``vehicles.url``."""
    system_id: Annotated[int, Field(ge=0, le=255)] = 0
    """MAVLink system id that its vehicle must have; 0: the drone's id."""
    camera: str = ""
    """This drone's real camera: an RTSP URL, a V4L2 device such as /dev/video0, or a video file. Empty: the simulator
    renders what it would see."""
    body: str = ""
    """Name of its rigid body in the motion capture; empty: "drone-" and its id."""

    @property
    def rigid_body(self) -> str:
        """The name of its body in the motion capture."""
        return self.body or f"drone-{self.id}"

    @property
    def mavlink_system(self) -> int:
        """The id that its vehicle must have."""
        return self.system_id or self.id


class Mission(Settings):
    """The whole mission. ``drones`` may be left out: then ``covrecon run --drones N`` places them."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")] = "mission"
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1
    duration_s: Positive = 1500.0
    """The mission ends after so long (paper: up to 1500 s) ..."""
    stop_below: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """... or when J falls below this."""
    start: Literal["at_once", "on_command"] = "at_once"
    """Whether drones take off as soon as all are there, or when an operator says "start"."""
    target: Target = Target()
    sensing: Sensing = Sensing()
    flight: Flight = Flight()
    controller: Controller = Controller()
    planners: Planners = Planners()
    feedback: Feedback = Feedback()
    camera: Camera = Camera()
    localization: Localization = Localization()
    lidar: Lidar = Lidar()
    mocap: Mocap = Mocap()
    reconstruction: Reconstruction = Reconstruction()
    simulation: Simulation = Simulation()
    vehicles: Vehicles = Vehicles()
    autopilot: Autopilot = Autopilot()
    transport: Transport = Transport()
    replication: Replication = Replication()
    console: Console = Console()
    recording: Recording = Recording()
    metrics: Metrics = Metrics()
    drones: Annotated[tuple[Drone, ...], Field(min_length=1)]

    @property
    def tick_s(self) -> float:
        return 1.0 / self.controller.rate_hz

    @property
    def measures_depth(self) -> bool:
        """Whether keyframes carry depth."""
        return self.camera.depth or self.reconstruction.backend == "depth"

    @property
    def scan_ticks(self) -> int:
        """Between two scans of a lidar."""
        return round(self.controller.rate_hz / self.lidar.rate_hz)

    @property
    def mocap_ticks(self) -> int:
        """Between two poses of a simulated capture."""
        return max(1, round(self.controller.rate_hz / self.mocap.rate_hz))

    def sweep_intrinsics(self) -> Intrinsics:
        """Of depth images, computed and measured."""
        width = self.reconstruction.sweep_width_px
        return self.camera.intrinsics().scaled_to(width, round(width * self.camera.height_px / self.camera.width_px))

    def drone(self, number: int) -> Drone:
        """The drone with this id. Raises `StopIteration` when there is none."""
        return next(drone for drone in self.drones if drone.id == number)

    def vehicle_url(self, drone: Drone) -> str:
        """The drone's own, or that of ``vehicles`` counted up by the drone's place in the mission."""
        if drone.url:
            return drone.url
        host, _, port = self.vehicles.url.rpartition(":")
        return f"{host}:{int(port) + self.drones.index(drone)}"

    @model_validator(mode="after")
    def _parts_fit_together(self) -> Self:
        faults = []
        ids = [drone.id for drone in self.drones]
        if len(set(ids)) != len(ids):
            faults.append(f"drones: ids must differ, got {ids}")
        low, high = self.flight.pitch_limits_rad
        for index, drone in enumerate(self.drones):
            if not self.flight.contains(drone.start[:3]):
                faults.append(f"drones.{index}.start: {list(drone.start[:3])} lies outside the flight region")
            if not low <= drone.start[4] <= high:
                faults.append(f"drones.{index}.start: pitch {drone.start[4]:g} lies outside flight.pitch_limits_rad")
            for other in range(index):
                gap = math.dist(drone.start[:3], self.drones[other].start[:3])
                if gap < self.flight.separation_m:
                    faults.append(
                        f"drones.{index}.start: {gap:.2f} m from drone {self.drones[other].id},"
                        f" less than flight.separation_m {self.flight.separation_m:g}"
                    )
        if self.flight.has_zones:
            from protocol.free_space import start_faults

            faults += start_faults(self.flight, self.drones)
        if self.flight.obstacles.enabled:
            from protocol.obstacle_grid import obstacle_faults

            faults += obstacle_faults(self)
        gain = self.controller.separation_gain_per_s * self.tick_s
        if gain > 0.5:
            faults.append(
                f"controller.separation_gain_per_s: times the tick is {gain:g}, must be at most 0.5:"
                " two drones could pass their barrier within one tick"
            )
        turn = self.flight.pitch_rate_max_radps * self.tick_s
        if high - low < 2 * turn:
            faults.append(
                f"flight.pitch_limits_rad: {high - low:g} apart, must be at least {2 * turn:g}:"
                " the gimbal could pass a limit within one tick"
            )
        if self.controller.smoothing > 0 and self.controller.planner != "coverage":
            faults.append(f'controller.smoothing: planner "{self.controller.planner}" has none, only "coverage"')
        heights = self.flight.lower_m[2], self.flight.upper_m[2]
        faults += planner_faults(self.controller.planner, self.planners, heights, self.flight.pitch_limits_rad)
        if self.vehicles.kind == "px4":
            faults += self._vehicle_faults()
        else:
            faults += [
                f'drones.{index}.camera: a real camera needs a real vehicle, vehicles.kind = "px4"'
                for index, drone in enumerate(self.drones)
                if drone.camera
            ]
        if self.measures_depth:
            faults += [
                f"drones.{index}.camera: gives no depth, which camera.depth or reconstruction.backend asks for"
                for index, drone in enumerate(self.drones)
                if drone.camera
            ]
        if self.localization.source == "lidar":
            faults += self._lidar_faults()
        if self.localization.source == "mocap":
            faults += self._mocap_faults()
        faults += battery_faults(self.simulation.battery, self.vehicles)
        if self.vehicles.kind == "px4" or self.vehicles.battery_swap_s > 0:
            faults += self._column_faults()
        faults += self.transport.faults()
        if self.reconstruction.nearest_m >= self.reconstruction.farthest_m:
            faults.append("reconstruction.nearest_m: must be less than farthest_m")
        if faults:
            raise ValueError("\n".join(faults))
        return self

    def _lidar_faults(self) -> list[str]:
        faults = []
        if self.vehicles.kind != "simulated":
            faults.append('localization.source: "lidar" has simulated lidars alone; give PX4 its poses (docs/px4.md)')
        elif not self.simulation.scene:
            faults.append('localization.source: "lidar" needs a scene to measure, simulation.scene')
        if self.lidar.rate_hz > self.controller.rate_hz:
            faults.append(f"lidar.rate_hz: must be at most controller.rate_hz, {self.controller.rate_hz:g}")
        return faults

    def _mocap_faults(self) -> list[str]:
        faults = []
        if self.vehicles.origin is not None:
            faults.append("vehicles.origin: must be left out, the world frame is the motion capture's")
        if self.vehicles.camera_mount == "gimbal":
            faults.append(
                'vehicles.camera_mount: "gimbal" turns the camera, and motion capture sees the vehicle\'s yaw'
            )
        bodies: dict[str, int] = {}
        for index, drone in enumerate(self.drones):
            if bodies.setdefault(drone.rigid_body, drone.id) != drone.id:
                taken = bodies[drone.rigid_body]
                faults.append(f"drones.{index}.body: {drone.rigid_body!r} is drone {taken}'s already")
        return faults

    def _vehicle_faults(self) -> list[str]:
        """Two agents on one vehicle, or two vehicles that MAVSDK would take for one."""
        if not re.fullmatch(r"[a-z]+://[^:]*:\d+", self.vehicles.url):
            return [f"vehicles.url: {self.vehicles.url!r} is no connection with a port, like udpin://127.0.0.1:14540"]
        faults = []
        urls: dict[str, int] = {}
        systems: dict[int, int] = {}
        for index, drone in enumerate(self.drones):
            url, system = self.vehicle_url(drone), drone.mavlink_system
            if url in urls:
                faults.append(f"drones.{index}.url: {url} is drone {urls[url]}'s already")
            if system in systems:
                faults.append(f"drones.{index}.system_id: {system} is drone {systems[system]}'s already")
            urls.setdefault(url, drone.id)
            systems.setdefault(system, drone.id)
        return faults

    def _column_faults(self) -> list[str]:
        """Vehicles that climb and land by themselves do so straight up and down."""
        room = widened_separation(self.flight)
        return [
            f"drones.{index}.start: {gap:.2f} m beside drone {other.id}; to take off and land it takes"
            f" {room:.2f} m, flight.separation_m and what lag and position_error_m add"
            for index, drone in enumerate(self.drones)
            for other in self.drones[:index]
            if (gap := math.dist(drone.start[:2], other.start[:2])) < room
        ]
