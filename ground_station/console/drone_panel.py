"""One drone, chosen by the operator: its orders, what its camera saw last, and why it goes where it goes."""

from __future__ import annotations

import viser

from ground_station.console import markup
from ground_station.console.command_sender import CommandSender
from ground_station.console.explanation import Explanation
from ground_station.console.orders_panel import DRONE_ORDERS, OrdersPanel, Post
from protocol.messages import Keyframe
from protocol.mission import Mission


class DronePanel:
    def __init__(self, gui: viser.GuiApi, mission: Mission, sender: CommandSender, post: Post) -> None:
        self._tick_s = mission.tick_s
        self._drones = {f"drone {drone.id}": drone.id for drone in mission.drones}
        self._choice = gui.add_dropdown("Drone", tuple(self._drones))
        self._orders = OrdersPanel(gui, DRONE_ORDERS, "this drone", lambda: (self.chosen,), sender, post)
        self._picture = gui.add_html("")
        self._shown: tuple[int, int] | None = None
        self.draw(None)

    @property
    def chosen(self) -> int:
        return self._drones[self._choice.value]

    def draw(self, keyframe: Keyframe | None) -> None:
        """The newest of the drone that is chosen."""
        shown = None if keyframe is None else (keyframe.drone, keyframe.sequence)
        if shown is None or shown != self._shown:
            self._shown = shown
            self._picture.content = markup.picture(keyframe, self._tick_s)


class WhyPanel:
    def __init__(self, gui: viser.GuiApi) -> None:
        self._why = gui.add_html("")

    def draw(self, drone: int, explanation: Explanation | None) -> None:
        self._why.content = markup.why(drone, explanation)
