"""Buttons that command drones, and the question that is asked before what cannot be taken back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import viser

from ground_station.console.command_sender import CommandSender
from ground_station.console.markup import box
from protocol.verbs import Verb

Post = Callable[[Callable[[], None]], None]
"""Runs a call in the event loop: viser's callbacks come in threads of its own."""


@dataclass(frozen=True, slots=True)
class Order:
    """A button; ``question`` is asked first, if there is one."""

    verb: Verb
    icon: viser.IconName
    colour: Literal["green", "blue", "yellow", "orange", "red"]
    question: str = ""


MISSION_ORDERS = (
    Order("start", viser.Icon.PLAYER_PLAY, "green"),
    Order("pause", viser.Icon.PLAYER_PAUSE, "blue"),
    Order("resume", viser.Icon.PLAYER_TRACK_NEXT, "blue"),
    Order("return", viser.Icon.HOME, "yellow", "fly to their starts and land there"),
    Order("land", viser.Icon.ARROW_BAR_TO_DOWN, "orange", "come down where they are"),
    Order("abort", viser.Icon.ALERT_OCTAGON, "red", "come down where they are, and the mission ends"),
)
DRONE_ORDERS = (
    Order("pause", viser.Icon.PLAYER_PAUSE, "blue"),
    Order("resume", viser.Icon.PLAYER_TRACK_NEXT, "blue"),
    Order("return", viser.Icon.HOME, "yellow", "flies to its start and lands there"),
    Order("land", viser.Icon.ARROW_BAR_TO_DOWN, "orange", "comes down where it is"),
)


class OrdersPanel:
    """A row of buttons for the drones that ``chosen`` names when one is pressed; for all where it names none."""

    def __init__(
        self,
        gui: viser.GuiApi,
        orders: Sequence[Order],
        whom: str,
        chosen: Callable[[], tuple[int, ...]],
        sender: CommandSender,
        post: Post,
    ) -> None:
        """``whom``: what the buttons say after the verb, "all" or "this drone"."""
        self._chosen, self._sender, self._post = chosen, sender, post
        self.buttons: dict[Verb, viser.GuiButtonHandle] = {}
        for order in orders:
            label = f"{order.verb.capitalize()} {'mission' if order.verb in ('start', 'abort') else whom}"
            button = gui.add_button(label, icon=order.icon, color=order.colour)
            self.buttons[order.verb] = button
            self._connect(button, order)

    def _connect(self, button: viser.GuiButtonHandle, order: Order) -> None:
        button.on_click(lambda event: self._post(lambda: self._press(order, event.client)))

    def _press(self, order: Order, client: viser.ClientHandle | None) -> None:
        drones = self._chosen()
        if not order.question:
            self._sender.send(order.verb, drones)
        elif client is not None:  # who has left cannot answer
            self._ask(order, drones, client)

    def _ask(self, order: Order, drones: tuple[int, ...], client: viser.ClientHandle) -> None:
        """On the page where the button was pressed; the drones stay those of the question, whatever is chosen since."""
        whom = f"drone {', '.join(map(str, drones))}" if drones else "all drones"
        gui = client.gui
        with gui.add_modal(f"{order.verb.capitalize()} {whom}?") as modal:
            gui.add_html(box(escape(f"{whom[0].upper()}{whom[1:]} {order.question}. This cannot be taken back.")))
            yes = gui.add_button(f"Yes, {order.verb} {whom}", color=order.colour)
            no = gui.add_button("No", color="gray")

        def answer(confirmed: bool) -> None:
            if modal.closed:  # pressed twice
                return
            modal.close()
            if confirmed:
                self._sender.send(order.verb, drones)

        yes.on_click(lambda _: self._post(lambda: answer(True)))
        no.on_click(lambda _: self._post(lambda: answer(False)))
