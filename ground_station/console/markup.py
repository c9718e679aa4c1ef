"""What the panels say, as HTML. Whatever came over the bus is escaped here: the browser takes it all for markup."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape

from ground_station.console.command_sender import Sent
from ground_station.console.events import Level
from ground_station.console.explanation import Explanation
from ground_station.console.fleet import FleetRow, Severity
from protocol.messages import Event, Keyframe, Status

SEVERITY_COLOURS: Mapping[Severity, str] = {
    "good": "#37b24d",
    "notice": "#4dabf7",
    "warning": "#f59f00",
    "bad": "#fa5252",
}
LEVEL_COLOURS: Mapping[Level, str] = {"info": "inherit", "warning": "#f59f00", "error": "#fa5252"}
QUIET = "opacity:.65"
TABLE = "width:100%;border-collapse:collapse;font-size:12px;font-variant-numeric:tabular-nums;line-height:1.35"
CELL = "padding:2px 5px;text-align:right;white-space:nowrap"
WORDS_CELL = "padding:2px 5px;text-align:left"
GROUND_LATE_S = 2.0
"""The ground station speaks twice a second."""
SECONDS_A_MINUTE = 60


def box(content: str, style: str = "") -> str:
    """All panels' text in the same letters and margins."""
    return f'<div style="padding:0 .75em .5em;font-size:13px;line-height:1.45;{style}">{content}</div>'


def summary(status: Status | None, reason: str, duration_s: float, ground_age_s: float | None) -> str:
    """The mission in five lines. ``reason``: why it is over, or what it waits for."""
    link = _ground_link(ground_age_s)
    if status is None:
        return box(link)
    rows = [
        ("mission time", f"{_clock(status.time_s)} of {_clock(duration_s)}"),
        ("importance J", f"{status.importance:.3f}"),
        ("F-score visible, objects", f"{status.f_score_visible:.3f}, {status.f_score_objects:.3f}"),
        ("keyframes, map jumps", f"{status.keyframes} ({status.keyframes_per_s:.1f}/s), {status.jumps}"),
        ("smallest distance", f"{status.min_separation_m:.2f} m" if len(status.drones) > 1 else "–"),
    ]
    if status.dropped or status.refused or status.unwritten:
        rows.append(("unused, refused, not on disk", f"{status.dropped}, {status.refused}, {status.unwritten}"))
    lines = "".join(
        f'<tr><td style="{WORDS_CELL};{QUIET}">{name}</td><td style="{CELL}">{value}</td></tr>' for name, value in rows
    )
    heading = f'<div style="font-weight:600">{escape(status.phase)}</div>'
    what = f'<div data-console="activity">{escape(reason or status.activity)}</div>'
    return box(f'{heading}{what}{link}<table style="{TABLE}">{lines}</table>')


def _ground_link(age_s: float | None) -> str:
    if age_s is None:
        return f'<div data-console="link" style="{QUIET}">waiting for the ground station</div>'
    if age_s > GROUND_LATE_S:
        text = f"ground station not heard for {_clock(age_s)}; what is shown is old"
        return f'<div data-console="link" style="color:{SEVERITY_COLOURS["bad"]};font-weight:600">{text}</div>'
    return ""


def commands(sent: Sequence[Sent]) -> str:
    """The newest first, in full; earlier ones in a line each."""
    if not sent:
        return box(f'<span data-console="command" style="{QUIET}">no command yet</span>')
    first, *earlier = (_command(command) for command in sent)
    older = "".join(f'<div style="{QUIET};font-size:11px">{line}</div>' for line in earlier)
    return box(f'<div data-console="command">{first}</div>{older}')


def _command(command: Sent) -> str:
    whom = "all" if not command.drones else "drone " + ", ".join(map(str, command.drones))
    awaited = "drones " + ", ".join(map(str, command.awaited))
    colour, words = {
        "asked": ("notice", "sent" if command.link else "sent, no answer from the ground station; trying on"),
        "awaited": ("notice", f"awaiting {awaited}" + ("" if command.link else "; ground station does not answer")),
        "acknowledged": ("good", "acknowledged"),
        "refused": ("bad", f"refused: {command.text}"),
        "unanswered": ("bad", "the ground station did not answer: press again if it is still wanted"),
        "replaced": ("notice", "replaced by a newer command"),
    }[command.progress]
    style = f"color:{SEVERITY_COLOURS[colour]}"  # type: ignore[index]  # severities, all of them
    return f'<b>{command.verb} {whom}</b>: <span style="{style}">{escape(words)}</span>'


def fleet(rows: Sequence[FleetRow], colours: Mapping[int, str]) -> str:
    """``colours``: of each drone, as CSS."""
    heads = ("", "mode", "battery", "link", "margin", "slack", "brakes", "QP")
    head = "".join(f'<th style="{CELL};font-weight:500;{QUIET}">{name}</th>' for name in heads)
    body = "".join(_fleet_row(row, colours.get(row.drone, "#888888")) for row in rows)
    return box(f'<table data-console="fleet" style="{TABLE}"><tr>{head}</tr>{body}</table>')


def _fleet_row(row: FleetRow, colour: str) -> str:
    mode = f'<span style="color:{SEVERITY_COLOURS[row.severity]};font-weight:600">{escape(row.mode)}</span>'
    cells = [
        f'<b style="color:{colour}">&#9632; {row.drone}</b>',
        mode,
        _number(row.battery, "{:.0%}"),
        _number(row.link_age_s, "{:.1f} s"),
        _number(row.separation_margin_m2, "{:.2f} m²"),
        _number(row.slack, "{:.3f}"),
        _number(row.fallbacks, "{}"),
        _number(row.solve_ms, "{:.1f} ms"),
    ]
    numbers = "".join(f'<td style="{CELL}">{cell}</td>' for cell in cells)
    notes = "; ".join([*row.reasons, *([f"held back by {row.active}"] if row.active else [])])
    more = f'<tr><td></td><td colspan="7" style="{WORDS_CELL};{QUIET}">{escape(notes)}</td></tr>' if notes else ""
    return f"<tr>{numbers}</tr>{more}"


def events(newest: Sequence[Event], tick_s: float) -> str:
    """A table, as many rows as are given."""
    if not newest:
        return box(f'<span style="{QUIET}">none</span>')
    rows = "".join(
        f'<tr style="color:{LEVEL_COLOURS[event.level]}"><td style="{CELL}">{_clock(event.tick * tick_s)}</td>'
        f'<td style="{WORDS_CELL};white-space:nowrap">{escape(event.source)}</td>'
        f'<td style="{WORDS_CELL}">{escape(event.kind)}</td><td style="{WORDS_CELL}">{escape(event.text)}</td></tr>'
        for event in newest
    )
    return box(f'<table data-console="events" style="{TABLE}">{rows}</table>')


def why(drone: int, explanation: Explanation | None) -> str:
    """None while the drone or the importance is not known."""
    if explanation is None:
        return box(f'<b>drone {drone}</b> <span style="{QUIET}">not known yet</span>')
    lines = "".join(f"<li>{escape(line)}</li>" for line in explanation.lines)
    return box(f'<b>drone {drone}</b><ul data-console="why" style="margin:0;padding-left:1.2em">{lines}</ul>')


def picture(keyframe: Keyframe | None, tick_s: float) -> str:
    """The JPEG as it came: nothing is decoded here."""
    if keyframe is None:
        return box(f'<span style="{QUIET}">no picture yet</span>')
    data = base64.b64encode(keyframe.jpeg).decode()
    caption = f"picture {keyframe.sequence} at {_clock(keyframe.tick * tick_s)}"
    image = f'<img data-console="picture" alt="{caption}" style="width:100%" src="data:image/jpeg;base64,{data}">'
    return box(f'{image}<div style="{QUIET};font-size:11px">{caption}</div>')


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(max(0.0, seconds), SECONDS_A_MINUTE)
    return f"{int(minutes)}:{int(rest):02d}"
