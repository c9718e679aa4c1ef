"""When a vehicle that has landed counts as fit to fly again."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest

from agents.vehicles.px4 import recheck
from agents.vehicles.px4.recheck import FRESH_S, Recheck


async def test_what_was_found_fit_is_taken_once_and_stays_so_for_a_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, found, begun = [100.0], object(), []

    async def prepare(*_: Any) -> object:
        return found

    monkeypatch.setattr(recheck, "prepare_vehicle", prepare)
    preparation: Any = SimpleNamespace(start_over=begun.append)
    with ThreadPoolExecutor(1) as executor:
        again = Recheck(preparation, executor, lambda: now_s[0], lambda _level, _text: None)
        assert not again.is_fit
        again.begin()
        assert again.is_running
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert again.is_running, "until it is taken; else it would be begun again and again"
        assert again.take() is found
        assert again.take() is None
        assert not again.is_running
        assert again.is_fit
        now_s[0] += FRESH_S + 0.1
        assert not again.is_fit
        again.begin()
        assert begun == [100.0, now_s[0]]
        again.cancel()
