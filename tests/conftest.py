"""What holds for all tests."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import settings

TESTS = Path(__file__).parent

settings.register_profile("covrecon", deadline=None)  # no test is timed: machines are shared
settings.load_profile("covrecon")


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist looks for the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that fly missions of processes run one after another, on one worker: they would starve each other of cores.
    So do those that start a process or two, or several that do not mind waiting: they may run beside a flight."""
    for item in items:
        if "light" in item.keywords:
            item.add_marker(pytest.mark.xdist_group("light"))
        elif item.path.relative_to(TESTS).parts[0] in ("integration", "benchmarks") or "processes" in item.keywords:
            item.add_marker(pytest.mark.xdist_group("processes"))


@pytest.fixture
def root_path() -> Path:
    """The project's root, for files that are shipped."""
    return TESTS.parent
