"""docs/px4.md says what the code does."""

from __future__ import annotations

import json

from faults.px4_tables import FEATURES, PAGE, features, fill, policies


def test_the_page_has_the_policies_of_the_code_and_the_last_contract_run() -> None:
    page = PAGE.read_text()
    assert fill(page, "policies", policies()) == page, "run python -m faults.px4_tables"
    assert fill(page, "features", features(json.loads(FEATURES.read_text()))) == page


def test_a_backend_that_was_not_tried_is_told_as_such() -> None:
    table = features({"endpoint": {"hold": "passed", "battery": "failed"}})
    assert table.splitlines()[0] == "| feature | endpoint | PX4 |"
    assert table.splitlines()[2:] == ["| battery | **no** | not run |", "| hold | yes | not run |"]
