"""Which state of each drone was the newest at a tick; a recording keeps each drone's states on a channel of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from protocol.messages import DroneState


class NewestStates:
    """Goes through the drones' states once, tick by tick."""

    def __init__(self, states: Mapping[int, Iterator[DroneState]]) -> None:
        """Of each drone by its id, as they came."""
        self._coming = {drone: (iterator, next(iterator, None)) for drone, iterator in states.items()}
        self._newest: dict[int, DroneState] = {}

    def at(self, tick: int) -> Mapping[int, DroneState]:
        """By drone id, those of ``tick`` or, where there is none, of the newest before it; drones that were not heard
        yet are missing. Asked for ascending ticks."""
        for drone, (iterator, coming) in self._coming.items():
            state = coming
            while state is not None and state.tick <= tick:
                known = self._newest.get(drone)
                if known is None or state.tick >= known.tick:
                    self._newest[drone] = state
                state = next(iterator, None)
            self._coming[drone] = (iterator, state)
        return self._newest
