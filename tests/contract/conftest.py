"""A matrix of backends and features out of the contract tests: ``COVRECON_MATRIX=FILE`` names the JSON to write.

A test says what it shows by ``@pytest.mark.feature("...")``, and on what by a fixture that records the property
``backend``. What is in the file already stays, so that several runs fill one matrix.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

_seen: dict[str, dict[str, str]] = {}
"""Backend to feature to outcome."""


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "feature(name): what a contract test shows, for the matrix of backends")


@pytest.fixture(autouse=True)
def _feature(request: pytest.FixtureRequest, record_property: Callable[[str, object], None]) -> None:
    mark = request.node.get_closest_marker("feature")
    if mark is not None:
        record_property("feature", mark.args[0])


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    properties = dict(report.user_properties)
    if "feature" not in properties or "backend" not in properties or (report.when != "call" and report.passed):
        return
    features = _seen.setdefault(str(properties["backend"]), {})
    feature = str(properties["feature"])
    if features.get(feature) != "failed":
        features[feature] = report.outcome


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Written by the one process that hears of all tests."""
    name = os.environ.get("COVRECON_MATRIX")
    if not name or not _seen or hasattr(session.config, "workerinput"):
        return
    path = Path(name)
    matrix = json.loads(path.read_text()) if path.exists() else {}
    for backend, features in _seen.items():
        matrix.setdefault(backend, {}).update(features)
    path.write_text(json.dumps(matrix, indent=2, sort_keys=True) + "\n")
