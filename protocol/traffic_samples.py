"""Messages as a mission in full flight sends them: what travels is measured by encoding them, not guessed."""

from __future__ import annotations

import math

import numpy as np

from protocol.aggregator import REPEATED
from protocol.blocks import SKETCHES, BlockLayout
from protocol.field import VirtualField
from protocol.messages import (
    UNLIMITED,
    Control,
    DroneState,
    ExternalPose,
    FreeCells,
    Jump,
    JumpHead,
    Keyframe,
    LidarScan,
    MissionPhase,
    PhiDigest,
    ReplicaState,
    Setpoint,
    TeamStates,
    Tick,
    Vector5,
    VehicleSample,
)
from protocol.mission import Mission
from protocol.obstacle_grid import ObstacleGrid
from protocol.team_states import pack

TICK = 70_000
"""An hour into a mission: numbers are as long as they get."""
EPOCH = 2**62 + 12_345
EARLIER = 3
"""Poses that a state repeats (`agents.agent.EARLIER_STATES`)."""
LOOKING_DOWN = ((0.0, -1.0, 0.0), (-0.97, 0.0, -0.24), (0.24, 0.0, -0.97))


def pose(drone: int, tick: int) -> Vector5:
    angle = 0.01 * tick + drone
    return (2 * math.cos(angle), 2 * math.sin(angle), 1.5 + 0.3 * math.sin(angle), angle % math.pi, 1.3)


def state(drone: int, *, obstacles: bool = False) -> DroneState:
    """With a decision that two barriers shaped, which is what most are; ``obstacles``: of a mission with them."""
    control = Control(
        tick=TICK - 1,
        outcome="solved",
        velocity=pose(drone, TICK + 1),
        slack=-0.123,
        sampling=0.0123,
        solve_s=0.0012,
        separation_margin_m2=0.345,
        region_margin_m=0.678,
        pitch_margin_rad2=0.0123,
        active=("pitch", "region:+z"),
        fallbacks=12,
        refused=0,
        telemetry_age_s=0.0123,
        obstacle_margin_m=0.456 if obstacles else UNLIMITED,
    )
    return DroneState(
        drone=drone,
        tick=TICK,
        pose=pose(drone, TICK),
        velocity=pose(drone, TICK + 2),
        battery=0.87,
        mode="flying",
        obeyed=3,
        earlier=tuple((TICK - back, pose(drone, TICK - back)) for back in range(EARLIER, 0, -1)),
        importance=0.456,
        replica=ReplicaState(tick=TICK, epoch=EPOCH, next_jump=321, missing=0, repaired=12, lost=34),
        control=control,
        position_sd_m=0.0123,
        angle_sd_rad=0.0123,
    )


def team_states(mission: Mission) -> TeamStates:
    return pack(
        (state(drone), [(TICK - back, pose(drone, TICK - back)) for back in range(1, REPEATED + 1)])
        for drone in sorted(drone.id for drone in mission.drones)
    )


def tick(mission: Mission) -> Tick:
    """The simulator's tells of its vehicles; an observer's does not."""
    drones = sorted(drone.id for drone in mission.drones)
    carried = drones if mission.vehicles.kind == "simulated" else []
    vehicles = [
        VehicleSample(
            drone=drone, pose=pose(drone, TICK), velocity=pose(drone, TICK + 2), battery=1.0, setpoint_tick=TICK - 1
        )
        for drone in carried
    ]
    return Tick(
        tick=TICK,
        time_s=TICK * mission.tick_s,
        lockstep=False,
        live=tuple(drones),
        vehicles=tuple(vehicles),
        jump_epoch=EPOCH,
        next_jump=321,
        keyframes=TICK,
    )


def setpoint(drone: int) -> Setpoint:
    return Setpoint(drone=drone, tick=TICK, velocity=pose(drone, TICK + 1))


def scan(mission: Mission, drone: int) -> LidarScan:
    """Of which every ray comes back."""
    return LidarScan(drone=drone, tick=TICK, points=np.zeros((mission.lidar.rays, 3), np.int16))


def external_pose(drone: int) -> ExternalPose:
    x, y, z, _, _ = pose(drone, TICK)
    return ExternalPose(
        drone=drone,
        tick=TICK,
        age_s=0.0123,
        position=(x, y, z),
        attitude=(0.97, 0.01, -0.02, 0.24),
        position_sd_m=0.00123,
        angle_sd_rad=0.0123,
    )


def keyframe(mission: Mission, drone: int, jpeg_bytes: int, depth_bytes: int = 0) -> Keyframe:
    camera = mission.camera.intrinsics()
    x, y, z, _, _ = pose(drone, TICK)
    return Keyframe(
        drone=drone,
        sequence=4321,
        tick=TICK,
        position=(x, y, z),
        rotation=LOOKING_DOWN,
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        jpeg=bytes(jpeg_bytes),
        depth=bytes(depth_bytes),
    )


def head() -> JumpHead:
    return JumpHead(epoch=EPOCH, next_sequence=321, done=TICK, phase="flying")


def phase() -> MissionPhase:
    """As long as nobody has commanded anything."""
    return MissionPhase(phase="flying", reason="")


def digest(mission: Mission) -> PhiDigest:
    count = BlockLayout(VirtualField.of(mission.target).shape).count
    return PhiDigest(epoch=EPOCH, tick=TICK, sketches=np.zeros((count, SKETCHES), np.float32))


def free_cells(mission: Mission) -> FreeCells:
    """Of a room that has been seen, and whose things are as rough as they get: no two columns end alike."""
    grid = ObstacleGrid.of(mission)
    tops = np.random.default_rng(0).integers(0, grid.shape[2], grid.shape[:2])
    return FreeCells(tick=TICK, packed=grid.pack(np.arange(grid.shape[2]) >= tops[..., None]))


def jump(mission: Mission) -> Jump:
    positions, _ = VirtualField.of(mission.target).shape
    return Jump(epoch=EPOCH, sequence=321, tick=TICK, increments=np.zeros(positions, np.float32))
