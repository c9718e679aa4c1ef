"""What a replay came to, in a few lines for a terminal."""

from __future__ import annotations

from collections.abc import Iterator

from ground_station.replay.run import Replayed

SURFACES = ("visible", "exposed", "objects")
UNKNOWN = "-"


def describe(replayed: Replayed) -> Iterator[str]:
    """Lines that say whether it is the same; with changed settings, a table of what it was and is."""
    comparison = replayed.comparison
    if replayed.changed:
        yield from _table(replayed)
    elif comparison.difference:
        yield f"not the same, first of all: {comparison.difference}"
        if replayed.losses:
            lost = ", ".join(f"{count} of {name}" for name, count in replayed.losses.items())
            yield f"the recording lacks messages for which there was no room in flight: {lost}"
    elif replayed.flown is not None:
        yield f"same phi, same map, {comparison.jumps} jumps equal"
    else:
        yield f"the same for {replayed.final.time_s:.1f} s, {comparison.jumps} jumps equal; there the recording ends"
    if replayed.page is not None:
        yield f"report: {replayed.page}"


def _table(replayed: Replayed) -> Iterator[str]:
    final, flown = replayed.final, replayed.flown or {}
    now: dict[str, float | None] = {"J": final.importance}
    for surface in SURFACES:
        now[f"f_score_{surface}"] = getattr(final.scores, surface).f if final.scores else None
    now |= {"jumps": final.jumps, "keyframes": final.keyframes}
    yield f"{'':<16}{'flown':>10}{'replayed':>10}"
    for name, value in now.items():
        yield f"{name:<16}{_figure(flown.get(name)):>10}{_figure(value):>10}"


def _figure(value: float | None) -> str:
    if value is None:
        return UNKNOWN
    return f"{value:d}" if isinstance(value, int) else f"{value:.3f}"
