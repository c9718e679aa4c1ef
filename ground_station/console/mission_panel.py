"""The mission as a whole: how far it is, orders for all drones, and what became of the last ones."""

from __future__ import annotations

import viser

from ground_station.console import markup
from ground_station.console.command_sender import CommandSender
from ground_station.console.orders_panel import MISSION_ORDERS, OrdersPanel, Post
from ground_station.console.situation import Situation
from protocol.mission import Mission


class MissionPanel:
    def __init__(self, gui: viser.GuiApi, mission: Mission, sender: CommandSender, post: Post) -> None:
        self._duration_s, self._sender = mission.duration_s, sender
        self._summary = gui.add_html("")
        self._orders = OrdersPanel(gui, MISSION_ORDERS, "all", lambda: (), sender, post)
        self._commands = gui.add_html("")
        self.draw_commands()

    def draw(self, situation: Situation) -> None:
        reason = situation.phase.reason if situation.phase is not None else ""
        self._summary.content = markup.summary(situation.status, reason, self._duration_s, situation.ground_age_s)
        waits = situation.phase is None or situation.phase.phase == "waiting"
        start = self._orders.buttons["start"]
        if start.visible != waits:
            start.visible = waits

    def draw_commands(self) -> None:
        self._commands.content = markup.commands(self._sender.newest_first)
