"""What carries the drones: ``[vehicles]`` and, for PX4-like vehicles of our own, ``[autopilot]`` of a mission file."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from protocol.settings import Latitude, Longitude, Metres, NonNegative, Positive, Settings, Share


class Parameter(Settings):
    name: Annotated[str, Field(pattern=r"^[A-Z0-9_]{1,16}$")]
    value: Annotated[float, Field(allow_inf_nan=False)]
    """A parameter that PX4 keeps as an integer takes a whole number."""


class Vehicles(Settings):
    """What carries the drones, and what is done when it cannot go on as planned (docs/px4.md)."""

    kind: Literal["simulated", "px4"] = "simulated"
    """The internal simulator's vehicles, or PX4 autopilots through MAVSDK: hardware, PX4 SITL, or our endpoint."""
    url: str = "udpin://127.0.0.1:14540"
    """MAVSDK connection of the first drone; the port of each next one is one higher, as PX4 SITL counts them. A drone's
    own ``url`` wins."""
    origin: tuple[Latitude, Longitude, Metres] | None = None
    """Latitude and longitude in degrees and height above mean sea level in metres of the world frame's origin; x is
    east, y north. Without it every vehicle's local frame is the world frame, as with motion capture."""
    camera_mount: Literal["gimbal_pitch", "gimbal", "fixed"] = "gimbal_pitch"
    """gimbal_pitch: the gimbal pitches and the vehicle yaws; gimbal: the gimbal does both; fixed: to the airframe, with
    the pitch of the drone's start."""
    start_tolerance_m: Positive = 1.0
    """How far, horizontally, a vehicle may stand from where the mission says it starts."""
    discovery_s: Positive = 30.0
    """How long a vehicle may take to be heard ..."""
    preflight_s: Positive = 60.0
    """... and then to pass its checks."""
    takeoff_s: Positive = 60.0
    """How long it may take from arming to flying what it is told."""
    parameters: tuple[Parameter, ...] = ()
    """PX4 parameters to set besides those of docs/px4.md, which they may replace."""
    telemetry_stale_s: Positive = 0.5
    """Older telemetry is not acted on: the vehicle is stopped ..."""
    telemetry_lost_s: Positive = 3.0
    """... and after so long told to land, should it still hear us."""
    setpoint_lost_s: Positive = 3.0
    """A control task silent for so long has its vehicle hold or land, by the watchdog; `Flight.setpoint_timeout_s`
    has stopped it before."""
    setpoint_lost: Literal["hold", "land"] = "hold"
    battery_low: Share = 0.25
    """Share left from which a drone returns to its start and lands ..."""
    battery_critical: Share = 0.1
    """... and from which it lands where it is."""
    reserve_factor: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 1.5
    """A drone returns while what is left above ``battery_critical`` is this many times what its way home and the
    landing take, at the use that it has measured ..."""
    battery_full_s: Positive = 1200.0
    """... and at least at that of a battery which lasts so long."""
    battery_swap_s: NonNegative = 0.0
    """How long a landed drone stands until a full battery is in; the simulated crew takes exactly so long. 0: nobody
    swaps, it stays on the ground."""
    battery_spares: Annotated[int, Field(ge=0)] | None = None
    """Spare batteries of each drone: who has used them up stays on the ground. Left out: as many as it takes."""
    swapped: Literal["on_command", "at_once"] = "on_command"
    """Whether a drone with a fresh battery takes off when an operator says "resume", hands off, or by itself. The
    simulated crew is quick: there it is always at once."""
    fence_margin_m: Positive = 0.5
    """Outside the flight region by so much, a drone lands."""
    jump_m: Positive = 0.5
    """An estimate that moves by so much more between two samples than the vehicle can is a jump: the drone holds."""
    gimbal_lost_s: Positive = 2.0
    """A gimbal that has not been heard or has not obeyed for so long is lost: the drone returns and lands."""
    gimbal_error_rad: Positive = 0.2
    """What "not obeyed" is."""
    at_end: Literal["return", "land", "hold"] = "return"
    """After the mission: return to the start and land there, land where it is, or stay in the air."""

    @model_validator(mode="after")
    def _limits_fit(self) -> Self:
        if self.battery_critical >= self.battery_low:
            raise ValueError("battery_critical must be less than battery_low")
        if self.telemetry_stale_s >= self.telemetry_lost_s:
            raise ValueError("telemetry_stale_s must be less than telemetry_lost_s")
        return self


class Autopilot(Settings):
    """PX4-like vehicles of our own that speak MAVLink (`sim_bridge.px4_endpoint`); they also obey [flight]."""

    wind_mps: tuple[Metres, Metres] = (0.0, 0.0)
    """Mean wind towards east and north; a vehicle leans into it."""
    gust_mps: NonNegative = 0.0
    """Standard deviation of what comes on top, with a second of memory."""
    position_noise_m: NonNegative = 0.02
    """Standard deviation of the estimate's slow wandering, each axis."""
    drift_mps: NonNegative = 0.0
    """How fast the estimate runs away from the place, in some direction, while external vision does not correct it."""
    satellites: bool = True
    """Whether there are any: without, EKF2_GPS_CTRL is 0, and there is no position before external vision tells it."""
    battery_s: Positive = 1200.0
    """Flight time of a full battery. The crew changes it by ``vehicles.battery_swap_s`` and ``battery_spares``."""
    power_off_s: NonNegative = 0.0
    """For how long that takes the power from the autopilot, which then boots: no link, and then a local frame that
    begins anew. 0: it is fed meanwhile."""
    gimbal_rate_max_radps: Positive = 2.0
    """How fast the gimbal slews."""
    spool_up_s: NonNegative = 1.5
    """Between arming and leaving the ground."""
