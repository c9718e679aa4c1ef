"""What a recording holds, in a few lines for people; of one that was cut short, what is whole of it."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from ground_station.recording.reader import Recording


def describe(path: Path) -> str:
    """Raises `RecordingError` if it is none, or cannot be read."""
    recording = Recording.open(path, salvage=True)
    mission = recording.mission
    metrics = recording.metrics()
    begun = datetime.fromtimestamp(recording.epoch_ns // 10**9, UTC)
    lines = [
        f"{path}: {path.stat().st_size / 2**20:.1f} MiB",
        f"mission: {mission.name}, drones: {len(mission.drones)}, {_pace(recording)}",
        f"begun: {begun:%Y-%m-%d %H:%M:%S} UTC",
        f"flown: {metrics[-1]['time_s'] if metrics else 0:.1f} s, {_end(recording)}",
        "",
        *_table(recording.counts(), recording.losses()),
    ]
    return "\n".join(lines)


def _pace(recording: Recording) -> str:
    pace = "in lockstep" if recording.lossless else "in real time"
    return f"{pace}, after a restart of the ground station" if recording.resumed else pace


def _end(recording: Recording) -> str:
    if recording.torn:
        return f"cut short: 'covrecon recording repair {recording.path}' makes it whole"
    summary = recording.summary()
    return str(summary["exit_reason"]) if summary is not None else "the end is not in it"


def _table(counts: dict[str, int], losses: dict[str, int]) -> list[str]:
    names = sorted(counts.keys() | losses.keys())
    width = max(map(len, names))
    rows = [f"{name:{width}}  {counts.get(name, 0):8d}  {losses.get(name, 0):7d}" for name in names]
    return [f"{'channel':{width}}  messages  dropped", *rows]
