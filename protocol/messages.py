"""Every message that two processes exchange. SI units, world frame of `protocol.geometry`, ticks of the mission."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field

from protocol.wire import Finite, Message, WireArray

DroneId = Annotated[int, Field(ge=1, le=255)]
TickNumber = Annotated[int, Field(ge=0, le=2**32 - 1)]
"""At 20 Hz it lasts for seven years; one that is larger is a fault, and must not make anybody wait or allocate."""
Count = Annotated[int, Field(ge=0)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
"""Metres, radians or their rates; more than a thousand kilometres is a fault as well."""
Vector3 = tuple[Coordinate, Coordinate, Coordinate]
Vector5 = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]
"""x, y, z, camera yaw, camera pitch (depression), or their rates."""


def _of_length_one(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    if abs(math.hypot(*quaternion) - 1) > QUATERNION_TOLERANCE:
        raise ValueError(f"no rotation: its length is {math.hypot(*quaternion):g}, not 1")
    return quaternion


QUATERNION_TOLERANCE = 0.01
"""Of a rotation's length: float32 rounding is far below, a fault far above."""
Quaternion = Annotated[tuple[Finite, Finite, Finite, Finite], AfterValidator(_of_length_one)]
"""w, x, y, z."""
Deviation = Annotated[float, Field(ge=0, le=1e6)]
"""Standard deviation, in metres or radians; 0 where nobody tells one."""
UNLIMITED = 1e9
"""Margin of a kind of row that a drone has none of; a finite number, because infinities do not travel."""
EventLevel = Literal["info", "warning", "error"]
Text = Annotated[str, Field(max_length=1000)]
Outcome = Literal["solved", "infeasible", "out_of_time", "numerical", "none"]
"""What the solver said; anything but "solved" brakes. "none" before the first decision."""
Mode = Literal["starting", "flying", "braking", "joining", "holding", "returning", "landing", "landed", "yielded"]
"""starting: on the ground or taking off, also while a battery is changed; joining: waits for phi; braking: the solver
found no way; holding, returning and landing: by a policy, or because the mission is over; landed: stands on the ground
and will stay there; yielded: a pilot or the autopilot itself flies."""
Phase = Literal["waiting", "starting", "flying", "finished"]
"""waiting: for an operator's start."""


class VehicleSample(Message):
    """One vehicle's own estimate of where it is and how it moves."""

    name: ClassVar[str] = "vehicle_sample"
    drone: DroneId
    pose: Vector5
    velocity: Vector5
    battery: Annotated[float, Field(ge=0, le=1)]
    setpoint_tick: Annotated[int, Field(ge=-1)]
    """Tick of the setpoint that it flies, -1 before the first: how long a command takes is seen from it."""
    position_sd_m: Deviation = 0.0
    """Of the position, along the direction in which it is largest ..."""
    angle_sd_rad: Deviation = 0.0
    """... and of the yaw and pitch."""
    truth: Vector5 | None = None
    """The true pose, where a simulator's estimates are off; to judge by, never to fly by."""


class Tick(Message):
    """The simulator's beat: all that is true at the start of tick ``tick``."""

    name: ClassVar[str] = "tick"
    tick: TickNumber
    time_s: Finite
    lockstep: bool
    """Whether the next tick waits for everybody's answer to this one."""
    live: tuple[DroneId, ...]
    """Drones whose states this tick is to be integrated with, ascending."""
    vehicles: tuple[VehicleSample, ...]
    jump_epoch: Count
    next_jump: Count
    """Jumps with a smaller sequence number are out; each takes effect at its own tick."""
    keyframes: Count
    """Keyframes sent before this tick."""
    aground: tuple[DroneId, ...] = ()
    """Drones that stand on the ground and will fly again: their states are waited for, but nothing is integrated."""
    contacts: tuple[tuple[DroneId, Count], ...] = ()
    """Of drones that have touched the simulated scene, how often they began to; to judge by, never to fly by."""


class Setpoint(Message):
    """Velocity that a drone's agent wants flown from tick ``tick`` on; to the internal simulator alone."""

    name: ClassVar[str] = "setpoint"
    drone: DroneId
    tick: TickNumber
    velocity: Vector5
    land: bool = False
    """Come down here and stay, whatever is commanded later ..."""
    take_off: bool = False
    """... but for this: fly what is commanded again."""


class Control(Message):
    """How one tick's velocity came about: a safety filter that explains itself."""

    name: ClassVar[str] = "control"
    tick: TickNumber
    outcome: Outcome
    velocity: Vector5
    """What the vehicle said it was really sent."""
    slack: Finite
    """w of the QP: how far the sampling row falls short of the wished rate; 0 or negative."""
    sampling: Finite
    """I_i of eq. (10), the drone's contribution to the fall of J x m, 1/s."""
    solve_s: Finite
    separation_margin_m2: Finite
    """Smallest barrier value among the separation rows; negative: too close."""
    region_margin_m: Finite
    """Likewise among the rows of the flight region: its box, its boundary and its no-fly zones."""
    pitch_margin_rad2: Finite
    active: tuple[str, ...]
    """Rows that hold with equality."""
    fallbacks: Count
    """Ticks so far that braked because the solver did not say "solved"."""
    refused: Count
    """Messages that this process refused, had no room for or failed on so far."""
    telemetry_age_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    """Of what the decision was made by."""
    obstacle_margin_m: Finite = UNLIMITED
    """Like the region's among the rows of what was not seen free; negative also where a map has just learned of
    something beside the drone."""


class ReplicaState(Message):
    """How current one process's phi is, and what it took to keep it equal to the ground station's."""

    name: ClassVar[str] = "replica_state"
    tick: TickNumber
    """All earlier ticks are integrated. It lags the state's tick by at most `Replication.wait_s`."""
    epoch: Count
    """0 before any jump or page told it."""
    next_jump: Count
    """Jumps with a smaller sequence number are applied, or held for their tick."""
    missing: Count
    """Blocks whose values are not known: all of them after a late start, until the snapshot is in."""
    repaired: Count
    """Blocks that were fetched from the ground station so far because they had drifted."""
    lost: Count
    """States of live drones that did not come in time so far."""


class DroneState(Message):
    """Published by each agent every tick; the team's states are the log from which phi is integrated."""

    name: ClassVar[str] = "state"
    drone: DroneId
    tick: TickNumber
    pose: Vector5
    velocity: Vector5
    battery: Annotated[float, Field(ge=0, le=1)]
    mode: Mode
    obeyed: Count = 0
    """Number of the newest operator's order that it has heard (`DroneOrder.number`): the acknowledgement."""
    blind_s: Annotated[float, Field(ge=0, le=60)] = 0.0
    """How long the vehicle may have flown on since ``pose`` was true: its agent does not hear it, and it stops by
    itself."""
    earlier: Annotated[tuple[tuple[TickNumber, Vector5], ...], Field(max_length=8)] = ()
    """Ticks and poses of the states just before, repeated so that a lost message loses nothing."""
    importance: Finite
    """J of this replica before the tick is integrated."""
    replica: ReplicaState
    control: Control | None
    """The decision of the tick before."""
    position_sd_m: Deviation = 0.0
    """Of the position, along the direction in which it is largest: neighbours keep so much farther away ..."""
    angle_sd_rad: Deviation = 0.0
    """... and of the yaw and pitch."""
    climb_m: Annotated[float, Field(gt=0, le=1e6)] | None = None
    """So far straight up its vehicle is about to climb by itself, without giving way; None: it is not."""

    @property
    def landed(self) -> bool:
        return self.mode == "landed"


class TeamStates(Message):
    """What all drones that spoke lately said of where they are, gathered by the router: row k of the first arrays is
    the newest state of drone ``drones[k]``. Every pose comes in several messages, so that a lost one loses nothing."""

    name: ClassVar[str] = "team_states"
    drones: WireArray
    """uint8 (n,), ascending."""
    ticks: WireArray
    """int32 (n,); how old a state is."""
    poses: WireArray
    """float64 (n, 5), to the last bit as they were sent."""
    velocities: WireArray
    """float64 (n, 5)"""
    blind_s: WireArray
    """float64 (n,)"""
    landed: WireArray
    """uint8 (n,), 1 for a drone that stands on the ground and will stay there."""
    earlier_rows: WireArray
    """uint8 (m,), whose earlier poses follow: a row of the arrays above."""
    earlier_ticks: WireArray
    """int32 (m,)"""
    earlier_poses: WireArray
    """float64 (m, 5)"""
    position_sd_m: WireArray | None = None
    """float64 (n,), as in `DroneState`; None of a router that does not know them."""
    climb_m: WireArray | None = None
    """Likewise, 0 for those who are not about to."""


class Keyframe(Message):
    """One posed image. The image is a JPEG; the pose is that of the camera, not of the airframe."""

    name: ClassVar[str] = "keyframe"
    drone: DroneId
    sequence: Count
    tick: TickNumber
    position: Vector3
    rotation: tuple[Vector3, Vector3, Vector3]
    """Rows of the camera-to-world rotation; camera axes right, down, forward."""
    width: Annotated[int, Field(ge=1, le=8192)]
    height: Annotated[int, Field(ge=1, le=8192)]
    fx: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    fy: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    cx: Finite
    cy: Finite
    jpeg: bytes
    depth: bytes = b""
    """What a depth camera measured through the same lens (`protocol.depth_image`); empty without one."""
    position_sd_m: Deviation = 0.0
    """Of the position, along the direction in which it is largest ..."""
    angle_sd_rad: Deviation = 0.0
    """... and of the angles: poses that are too bad are left out of the map."""


class LidarScan(Message):
    """What one drone's lidar measured at the start of ``tick``."""

    name: ClassVar[str] = "lidar_scan"
    drone: DroneId
    tick: TickNumber
    points: WireArray
    """int16 (n, 3) millimetres, as seen from the sensor, levelled: x forward along the vehicle's yaw, y left, z up."""


class ExternalPose(Message):
    """Where motion capture, or whoever else looks from outside, sees a drone's body; empty while it does not."""

    name: ClassVar[str] = "external_pose"
    drone: DroneId
    tick: TickNumber
    """The newest of the mission when this was said, 0 before the first ..."""
    age_s: Annotated[float, Field(ge=0, le=60)]
    """... and how long before it was true."""
    position: Vector3 | None = None
    attitude: Quaternion | None = None
    """Of the body's axes (x forward, y left, z up) in the world's."""
    position_sd_m: Deviation = 0.0
    """Standard deviation of each coordinate ..."""
    angle_sd_rad: Deviation = 0.0
    """... and of the attitude about each axis; 0: ``[mocap]`` of the mission says them."""


class Jump(Message):
    """One map update's effect on phi, eq. (4); applied once and in order of ``sequence`` within ``epoch``."""

    name: ClassVar[str] = "jump"
    epoch: Count
    """Identity of the journal; a new one means that older jumps are void."""
    sequence: Count
    tick: TickNumber
    """Takes effect before this tick is integrated."""
    increments: WireArray
    """delta_2 h2, float32 (positions,), added to every direction of a position."""


class JumpHead(Message):
    """How far the ground station's journal has got; a replica that is behind knows what to fetch."""

    name: ClassVar[str] = "jump_head"
    epoch: Count
    next_sequence: Count
    done: TickNumber
    """All jumps that take effect up to and including this tick are out."""
    phase: Phase


class JournalPage(Message):
    """Reply to a range query of ``phi/journal?from=..;to=..``: encoded jumps in order, as many as fit a page."""

    name: ClassVar[str] = "journal_page"
    epoch: Count
    first_sequence: Count
    """Older jumps were compacted away: who needs them needs a snapshot."""
    next_sequence: Count
    jumps: tuple[bytes, ...]


class PhiDigest(Message):
    """Sketches of blocks of the ground station's phi, of all or, in a large field, of one part of them
    (`protocol.blocks.BlockLayout.parts`): replicas that differ fetch those blocks."""

    name: ClassVar[str] = "phi_digest"
    epoch: Count
    tick: TickNumber
    """All earlier ticks, and the jumps due by it, are in."""
    sketches: WireArray
    """float32 (blocks, `protocol.blocks.SKETCHES`)."""
    first_block: Count = 0
    """Which block the first of them is."""


class PhiPage(Message):
    """Reply to ``phi/blocks?blocks=3+7;from=120``: some blocks of phi, as many as fit a page."""

    name: ClassVar[str] = "phi_page"
    epoch: Count
    tick: TickNumber
    """All earlier ticks are in, at least the one asked for ..."""
    next_sequence: Count
    """... and all jumps below."""
    blocks: WireArray
    """int32 (n,), ascending."""
    phi: WireArray
    """float32 (positions of these blocks, directions), one block after the other."""


class DroneOrder(Message):
    """What an operator wants of one drone, from now on."""

    name: ClassVar[str] = "drone_order"
    drone: DroneId
    action: Literal["fly", "hold", "return", "land"]
    number: Count
    """Of the command it stems from; a later one is larger."""


class MissionPhase(Message):
    """Broadcast by the ground station, repeated: what everybody should be doing."""

    name: ClassVar[str] = "mission_phase"
    phase: Phase
    reason: Text
    orders: tuple[DroneOrder, ...] = ()
    """Of drones that an operator has commanded something; repeated until each says that it has heard, and after."""


class CommandReply(Message):
    """Reply to ``command/request?id=..;verb=land;drones=3+4``; without drones it is for all. The same id is the same
    command: whoever asks again learns how far it is."""

    name: ClassVar[str] = "command_reply"
    id: Annotated[str, Field(max_length=64)]
    accepted: bool
    text: Text
    """Why it is refused, or what it does."""
    number: Count
    """0 if refused."""
    awaited: tuple[DroneId, ...]
    """Drones that have not acknowledged it yet."""


class Event(Message):
    """Something a person should know of, said once."""

    name: ClassVar[str] = "event"
    source: Annotated[str, Field(max_length=40)]
    """Role of the process: "drone/3", "ground"."""
    tick: TickNumber
    level: EventLevel
    kind: Annotated[str, Field(max_length=40)]
    """What it is about: "mode", "order", "solver", "vehicle", "battery", "phi", "command", "link", "map",
    "disk", "position"."""
    text: Text


class DroneStatus(Message):
    """One row of the live table."""

    name: ClassVar[str] = "drone_status"
    drone: DroneId
    alive: bool
    mode: str
    position: Vector3
    speed_mps: Finite
    separation_m: Finite
    slack: Finite
    solve_s: Finite
    fallbacks: Count


class Status(Message):
    """What a person wants to see while the mission runs; about once a wall second."""

    name: ClassVar[str] = "status"
    phase: Phase
    activity: Text
    """What the ground station is doing, in words."""
    tick: TickNumber
    time_s: Finite
    importance: Finite
    f_score_visible: Finite
    f_score_objects: Finite
    keyframes: Count
    dropped: Count
    """Keyframes that were lost, or refused because the map cannot use them."""
    replica: ReplicaState
    """The ground station's own."""
    refused: Count
    """Messages that this process refused, had no room for or failed on so far."""
    unwritten: Count
    """Records that the disk refused so far, a jump among them: it is kept in memory and tried again."""
    loop_lag_s: Finite
    """How late the ground station's event loop wakes, 99th percentile of the last seconds."""
    keyframes_per_s: Finite
    """Per second of wall time."""
    jumps: Count
    min_separation_m: Finite
    """Smallest distance between two drones so far; 0 with a single drone."""
    drones: tuple[DroneStatus, ...]


BlockNumber = Annotated[int, Field(ge=-(2**20), le=2**20)]


class MeshBlock(Message):
    """The part of the map in one cube of the world: the faces whose centre lies in it."""

    name: ClassVar[str] = "mesh_block"
    key: tuple[BlockNumber, BlockNumber, BlockNumber]
    """Number of the cube along x, y, z (`ground_station.mesh_blocks`)."""
    revision: Count
    vertices: WireArray
    """float32 (V, 3) metres, world frame; no vertices: the block is empty now."""
    faces: WireArray
    """int32 (F, 3)"""
    colours: WireArray
    """uint8 (V, 3) sRGB."""


class MeshPage(Message):
    """Reply to ``map/blocks?epoch=..;since=120``: blocks that changed after that revision, as many as fit a page."""

    name: ClassVar[str] = "mesh_page"
    epoch: Count
    """Of the process that numbers the revisions; with another one all blocks known before are void."""
    revision: Count
    """What to ask for next."""
    complete: bool
    """Whether there was nothing left to say."""
    blocks: tuple[MeshBlock, ...]


class FreeCells(Message):
    """Which cells are free (`protocol.obstacle_grid`), all of them anew each time."""

    name: ClassVar[str] = "free_cells"
    tick: TickNumber
    """Takes effect at it."""
    packed: bytes
    """One bit a cell, x slowest, zlib."""
    with_vouched: bool = False
    """Whether they include what the mission vouches for, where the map does not know better. Else, from an earlier
    release, who reads them adds that."""


class KeyframePage(Message):
    """Reply to ``map/keyframes?epoch=..;from=120``: keyframes for a map that is made elsewhere, all that fit a page."""

    name: ClassVar[str] = "keyframe_page"
    epoch: Count
    """Of the list of keyframes; with another one all that was known before is void."""
    first: Count
    """Place in the list of the first one, as asked for; 0 of another epoch than asked for."""
    next: Count
    """What to ask for next."""
    keyframes: tuple[bytes, ...]
    """Encoded `Keyframe`, in the map's order."""
    wanted: bool
    """Whether the map of all keyframes before ``next`` is waited for."""


class ExternalMesh(Message):
    """The whole map of an external process, asked for by `KeyframePage.wanted`."""

    name: ClassVar[str] = "external_mesh"
    epoch: Count
    taken: Count
    """All keyframes before this place of their list are in it."""
    vertices: WireArray
    """float32 (V, 3) metres, world frame."""
    faces: WireArray
    """int32 (F, 3), counter-clockwise seen from the front."""
    colours: WireArray
    """uint8 (V, 3) sRGB."""
    fault: Text = ""
    """Why there is no map; then the arrays are empty."""
