"""``covrecon recording``: what a recording holds, and how one that was cut short is made whole."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

recording_app = App(name="recording", help="Look into recordings, and repair those that were cut short.")

RecordingPath = Annotated[Path, Parameter(help="A recording (.mcap).")]


@recording_app.command
def info(recording: RecordingPath = Path("runs/latest/recording.mcap"), /) -> None:
    """Say what a recording holds: mission, length, and messages of each channel with those that were dropped.

    Example: covrecon recording info runs/latest/recording.mcap
    """
    from rich.console import Console

    from ground_station.recording.description import describe

    Console(highlight=False, markup=False, soft_wrap=True).print(describe(recording))


@recording_app.command
def repair(recording: RecordingPath, /, *, out: Path | None = None) -> None:
    """Write what is whole of a recording that was cut short, by a crash or a full disk, to a new file.

    Example: covrecon recording repair runs/latest/recording.mcap

    Parameters
    ----------
    out
        The new file; by default NAME.repaired.mcap beside it.
    """
    from rich.console import Console

    from ground_station.recording.repair import repair as make_whole

    target = out or recording.with_suffix(".repaired.mcap")
    repaired = make_whole(recording, target)
    Console(highlight=False, markup=False, soft_wrap=True).print(
        f"{target}: {repaired.messages} messages, {repaired.duration_s:.1f} s of the mission;"
        f" {repaired.lost_bytes} of {repaired.size_bytes} bytes were torn or damaged"
    )
