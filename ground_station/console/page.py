"""The page as a whole: its panels around the scene, and how each comes to show the newest."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection

import numpy as np
import viser

from ground_station.console.command_sender import CommandSender
from ground_station.console.drone_panel import DronePanel, WhyPanel
from ground_station.console.explanation import Explanation, explain
from ground_station.console.fleet_panel import CoursePanel, EventsPanel, FleetPanel
from ground_station.console.mesh_cache import MeshCache, Redraw
from ground_station.console.mission_panel import MissionPanel
from ground_station.console.scene import Scene, ViewOptions
from ground_station.console.situation import Situation
from protocol.bus import Bus
from protocol.importance import ImportanceField
from protocol.mission import Mission

LEFT_PX, RIGHT_PX = 320, 480


class Page:
    def __init__(self, server: viser.ViserServer, mission: Mission, bus: Bus, situation: Situation) -> None:
        self._server, self._mission, self._situation = server, mission, situation
        loop = asyncio.get_running_loop()

        def post(call: Callable[[], None]) -> None:
            loop.call_soon_threadsafe(call)

        self._sender = CommandSender(bus, self._show_commands)
        gui = server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._mission_panel = MissionPanel(gui, mission, self._sender, post)
        drone, team, why = gui.add_panel(), gui.add_panel(), gui.add_panel()
        with drone.add_tab("Drone", viser.Icon.DRONE):
            self._drone_panel = DronePanel(gui, mission, self._sender, post)
        with team.add_tab("Fleet", viser.Icon.TABLE):
            self._fleet_panel = FleetPanel(gui, mission)
            self._course_panel = CoursePanel(gui)
        with team.add_tab("Events", viser.Icon.LIST):
            self._events_panel = EventsPanel(gui, mission, post)
        with why.add_tab("Why there?", viser.Icon.ROUTE):
            self._why_panel = WhyPanel(gui)
        with why.add_tab("View", viser.Icon.EYE):
            options = ViewOptions(gui, mission)
        gui.main_panel.dock_left()
        gui.main_panel.set_width(LEFT_PX)
        drone.dock_below(gui.main_panel)
        team.dock_right()
        team.set_width(RIGHT_PX)
        why.dock_below(team)
        self._scene = Scene(server, mission, options, post)

    @property
    def is_watched(self) -> bool:
        """Whether a browser is connected: nothing need be drawn for nobody."""
        return bool(self._server.get_clients())

    @property
    def map(self) -> MeshCache:
        return self._scene.map

    def draw_map(self, redraw: Redraw) -> None:
        with self._server.atomic():
            self._scene.draw_map(redraw)

    def draw_drones(self) -> None:
        with self._server.atomic():
            self._scene.draw_drones(self._situation)

    def draw_panels(self, alive: Collection[str]) -> None:
        """``alive``: roles with a liveliness token."""
        self._mission_panel.draw(self._situation)
        self._fleet_panel.draw(self._situation, alive)
        self._course_panel.draw(self._situation)
        self._events_panel.draw(self._situation)

    def draw_field(self, importance: ImportanceField | None) -> None:
        """What depends on phi, and is drawn as often: without one, only what the chosen drone's camera saw."""
        chosen = self._drone_panel.chosen
        states = self._situation.states()
        explanation: Explanation | None = None
        with self._server.atomic():
            self._scene.draw_trails(self._situation)
            self._scene.draw_free(chosen, self._situation)
            if importance is not None:
                poses = np.array([state.pose for state in states.values()]).reshape(-1, 5)
                self._scene.draw_field(importance.phi, list(states), poses)
                if chosen in states:
                    explanation = explain(
                        importance, self._mission.sensing, states, chosen, self._mission.controller.planner
                    )
            self._scene.draw_pulls(explanation, self._situation)
        self._why_panel.draw(chosen, explanation)
        self._drone_panel.draw(self._situation.drones[chosen].keyframe)

    async def close(self) -> None:
        await self._sender.close()

    def _show_commands(self) -> None:
        self._mission_panel.draw_commands()
