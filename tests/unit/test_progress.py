from __future__ import annotations

import io

from rich.console import Console

from deploy.progress import LiveDisplay, PlainDisplay
from protocol.guard import ROOT
from protocol.messages import DroneStatus, ReplicaState, Status
from protocol.mission_file import load_mission

DEMO = load_mission(ROOT / "missions" / "demo.toml")


def status(time_s: float, activity: str = "mapping") -> Status:
    def drone(number: int) -> DroneStatus:
        return DroneStatus(
            drone=number,
            alive=number != 2,
            mode="flying",
            position=(1.0, -2.0, 2.5),
            speed_mps=0.4,
            separation_m=1.23,
            slack=-0.5,
            solve_s=0.0012,
            fallbacks=3,
        )

    return Status(
        phase="flying",
        activity=activity,
        tick=round(time_s * 20),
        time_s=time_s,
        importance=0.5,
        f_score_visible=0.41,
        f_score_objects=0.32,
        keyframes=100,
        dropped=1,
        replica=ReplicaState(tick=1, epoch=1, next_jump=7, missing=0, repaired=0, lost=0),
        refused=0,
        unwritten=0,
        loop_lag_s=0.002,
        keyframes_per_s=8.0,
        jumps=7,
        min_separation_m=1.02,
        drones=(drone(1), drone(2)),
    )


def test_plain_lines_come_every_few_seconds_and_at_once_for_news() -> None:
    now = 0.0
    lines: list[str] = []
    display = PlainDisplay(lines.append, clock=lambda: now)

    for now in (0.0, 1.0, 4.9, 5.1):  # what the display's clock reads
        display.show(status(now))
    display.show(status(now, "writing the report"))

    assert [line.split()[0] for line in lines] == ["0.0", "5.1", "5.1"]
    assert "J 0.500" in lines[0]
    assert "drones 1/2" in lines[0]
    assert lines[-1].endswith("writing the report")


def test_the_live_table_shows_units_and_silent_drones() -> None:
    output = io.StringIO()
    console = Console(file=output, force_terminal=True, width=120, height=30, color_system=None)

    with LiveDisplay(console, DEMO, clock=lambda: 0.0) as display:
        display.say("drone-2 ended; see [logs]")
        display.show(status(60.0))

    shown = output.getvalue()
    assert "drone-2 ended; see [logs]" in shown
    for text in ("60 of 400 s", "speed [m/s]", "1.00, -2.00, 2.50", "silent", "flying", "1.20"):
        assert text in shown
