"""What tests of the bus share: how long they wait, who is there, and an answer."""

from __future__ import annotations

from protocol.bus import Bus
from protocol.messages import JournalPage

PATIENCE_S = 20.0


def page(epoch: int) -> JournalPage:
    return JournalPage(epoch=epoch, first_sequence=0, next_sequence=0, jumps=())


async def there(bus: Bus, other: Bus, role: str = "drone/1") -> None:
    """``other``, whose subscriptions are declared, is heard of by ``bus``: it hears what ``bus`` puts from now on."""
    other.announce(role)
    assert await bus.until(lambda: role in bus.alive, PATIENCE_S)
