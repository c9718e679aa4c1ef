"""Which message is due when: PX4's default rates, and those that SET_MESSAGE_INTERVAL asked for."""

from __future__ import annotations

from sim_bridge.px4_endpoint.telemetry import STREAMS


class Streams:
    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Default rates, as after booting."""
        self._period_s = {message: 1.0 / rate for message, (rate, _) in STREAMS.items()}
        self._due_s = dict.fromkeys(self._period_s, 0.0)

    def set(self, message: int, interval_us: float) -> bool:
        """0: the default rate; negative: never. False: there is no such stream."""
        if message not in STREAMS:
            return False
        self._due_s[message] = 0.0
        if interval_us < 0:
            self._period_s.pop(message, None)
        else:
            self._period_s[message] = interval_us / 1e6 or 1.0 / STREAMS[message][0]
        return True

    def due(self, now_s: float) -> list[int]:
        """Messages to send now; one that is late is sent once, not several times."""
        ready = []
        for message, period in self._period_s.items():
            due = self._due_s[message]
            if now_s >= due:
                ready.append(message)
                self._due_s[message] = due + period if now_s < due + period else now_s + period
        return ready
