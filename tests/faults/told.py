"""What a drone tells of itself, for tests of what is kept of it."""

from __future__ import annotations

from protocol.messages import UNLIMITED, Control, DroneState, Mode, Outcome


def told(
    *,
    solve_s: float = 0.001,
    slack: float = 0.0,
    outcome: Outcome = "solved",
    margins: tuple[float, float, float] = (1.0, 1.0, 0.1),
    mode: Mode = "flying",
    battery: float = 1.0,
    decided: bool = True,
    obstacle_m: float = UNLIMITED,
    position_sd_m: float = 0.0,
) -> DroneState:
    """A state without its pose. ``margins``: separation in m², region in m, pitch in rad²; ``obstacle_m``: likewise."""
    separation, region, pitch = margins
    control = Control.model_construct(
        solve_s=solve_s,
        slack=slack,
        outcome=outcome,
        telemetry_age_s=0.01,
        separation_margin_m2=separation,
        region_margin_m=region,
        pitch_margin_rad2=pitch,
        obstacle_margin_m=obstacle_m,
    )
    return DroneState.model_construct(
        mode=mode, battery=battery, control=control if decided else None, position_sd_m=position_sd_m
    )
