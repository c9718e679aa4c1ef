"""Text that came over the bus reaches the browser as text, and numbers that are not known as a dash."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import pytest

from ground_station.console import markup
from ground_station.console.command_sender import Progress, Sent
from ground_station.console.explanation import Explanation
from ground_station.console.fleet import FleetRow
from protocol.messages import Event, Keyframe, ReplicaState, Status

EVIL = "<script>alert(1)</script>\"'&"
STATUS = Status(
    phase="flying",
    activity="mapping",
    tick=1300,
    time_s=65.0,
    importance=0.5,
    f_score_visible=0.25,
    f_score_objects=0.125,
    keyframes=7,
    dropped=0,
    replica=ReplicaState(tick=0, epoch=0, next_jump=0, missing=0, repaired=0, lost=0),
    refused=0,
    unwritten=0,
    loop_lag_s=0.0,
    keyframes_per_s=1.5,
    jumps=2,
    min_separation_m=0.0,
    drones=(),
)
ROW = FleetRow(
    drone=3,
    mode="waiting",
    severity="notice",
    reasons=(),
    battery=None,
    link_age_s=None,
    active="",
    slack=None,
    fallbacks=None,
    solve_ms=None,
    separation_margin_m2=None,
)
EXPLANATION = Explanation(drone=3, tick=0, pulls=(), xi1=(0.0, 0.0, 0.0, 0.0, 0.0), opposed=0.0, lines=(EVIL,))
SENT = Sent("1f", "pause", (3,), "asked")


@pytest.mark.parametrize(
    "panel",
    [
        lambda: markup.summary(STATUS.model_copy(update={"activity": EVIL}), "", 400.0, 0.0),
        lambda: markup.summary(STATUS, EVIL, 400.0, 0.0),
        lambda: markup.commands([replace(SENT, progress="refused", text=EVIL)]),
        lambda: markup.fleet([replace(ROW, mode=EVIL, reasons=(EVIL,), active=EVIL)], {}),
        lambda: markup.events([Event(source=EVIL, tick=0, level="info", kind=EVIL, text=EVIL)], 0.05),
        lambda: markup.why(3, EXPLANATION),
    ],
    ids=["activity", "reason", "refusal", "fleet", "event", "explanation"],
)
def test_no_text_of_a_message_becomes_markup(panel: Callable[[], str]) -> None:
    assert "<script" not in panel()
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in panel()


def test_a_picture_is_carried_as_letters_and_digits_whatever_its_bytes_are() -> None:
    keyframe = Keyframe(
        drone=1,
        sequence=4,
        tick=40,
        position=(0.0, 0.0, 0.0),
        rotation=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        width=320,
        height=180,
        fx=1.0,
        fy=1.0,
        cx=0.0,
        cy=0.0,
        jpeg=b'"><script>',
    )

    source = re.search(r'src="([^"]*)"', markup.picture(keyframe, 0.05))

    assert source is not None
    assert source[1] == "data:image/jpeg;base64,Ij48c2NyaXB0Pg=="


def test_what_is_not_known_is_a_dash() -> None:
    assert markup.fleet([ROW], {}).count("–") == 6


def test_a_ground_station_is_called_silent_only_after_it_missed_several_beats() -> None:
    assert "not heard" not in markup.summary(STATUS, "", 400.0, 1.0)
    assert "not heard for 0:03" in markup.summary(STATUS, "", 400.0, 3.0)
    assert "waiting for the ground station" in markup.summary(None, "", 400.0, None)


@pytest.mark.parametrize(
    ("progress", "words"),
    [
        ("asked", "sent"),
        ("awaited", "awaiting drones 2, 3"),
        ("acknowledged", "acknowledged"),
        ("refused", "refused: why"),
        ("unanswered", "press again"),
        ("replaced", "replaced by a newer command"),
    ],
)
def test_each_progress_of_a_command_has_its_words(progress: Progress, words: str) -> None:
    told = markup.commands([replace(SENT, progress=progress, text="why", awaited=(2, 3))])

    assert "pause drone 3" in told
    assert words in told
