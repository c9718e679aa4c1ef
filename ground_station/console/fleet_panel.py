"""All drones at a glance, how the mission goes over time, and what happened."""

from __future__ import annotations

from collections.abc import Collection
from typing import get_args

import numpy as np
import viser
from viser import uplot

from ground_station.console import markup
from ground_station.console.events import EventFilter, Level
from ground_station.console.field_view import drone_colours
from ground_station.console.orders_panel import Post
from ground_station.console.situation import CURVES, Situation
from protocol.geometry import Floats
from protocol.mission import Mission

INK, GRID = "#adb5bd", "#3b3f45"
"""On a dark page."""
CURVE_HEIGHT_PX = 180
TOP = 1.04
"""Of the curves' axis: a line at 1 is to be seen whole."""
CURVE_NAMES = {"importance": "J", "f_score_visible": "F visible", "f_score_objects": "F objects"}
CURVE_COLOURS = {"importance": "#ffd43b", "f_score_visible": "#4dabf7", "f_score_objects": "#ff922b"}
EVENTS_SHOWN = 100
ALL = "all"


class FleetPanel:
    def __init__(self, gui: viser.GuiApi, mission: Mission) -> None:
        colours = drone_colours(range(len(mission.drones)))
        self._colours = {
            drone.id: "#" + bytes(colour).hex() for drone, colour in zip(mission.drones, colours, strict=True)
        }
        self._fleet = gui.add_html("")

    def draw(self, situation: Situation, alive: Collection[str]) -> None:
        self._fleet.content = markup.fleet(situation.fleet(alive), self._colours)


class CoursePanel:
    """J and F over mission time: both lie between 0 and 1."""

    def __init__(self, gui: viser.GuiApi) -> None:
        nothing: Floats = np.zeros(1)
        axis = uplot.Axis(stroke=INK, grid=uplot.Axis_Grid(stroke=GRID, width=1), ticks=uplot.Axis_Ticks(stroke=GRID))
        self._plot = gui.add_uplot(
            data=(nothing, *(nothing for _ in CURVES)),
            series=(
                uplot.Series(label="mission time (s)"),
                *(uplot.Series(label=CURVE_NAMES[name], stroke=CURVE_COLOURS[name], width=2) for name in CURVES),
            ),
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=(0.0, TOP))},
            axes=(axis, axis),
            legend=uplot.Legend(show=True),
            height=CURVE_HEIGHT_PX,
        )
        self._until_s = 0.0

    def draw(self, situation: Situation) -> None:
        curves = situation.history.curves
        if len(curves[0]) and curves[0][-1] != self._until_s:
            self._until_s = curves[0][-1]
            self._plot.data = curves


class EventsPanel:
    def __init__(self, gui: viser.GuiApi, mission: Mission, post: Post) -> None:
        self._gui, self._tick_s = gui, mission.tick_s
        sources = (ALL, "ground", *(f"drone/{drone.id}" for drone in mission.drones))
        self._level = gui.add_dropdown("At least", get_args(Level))
        self._source = gui.add_dropdown("From", sources)
        self._text = gui.add_text("Containing", "")
        self._list = gui.add_html("")
        self._situation: Situation | None = None
        for choice in (self._level, self._source, self._text):
            choice.on_update(lambda _: post(self._redraw))

    def draw(self, situation: Situation) -> None:
        self._situation = situation
        self._redraw()

    def _redraw(self) -> None:
        if self._situation is None:
            return
        source = "" if self._source.value == ALL else self._source.value
        chosen = EventFilter(level=self._level.value, source=source, text=self._text.value)
        newest = self._situation.events.newest(EVENTS_SHOWN, chosen)
        self._list.content = markup.events(newest, self._tick_s)
