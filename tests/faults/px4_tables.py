"""Writes the tables of docs/px4.md: the policies as the code has them, and what the contract tests showed on which PX4.

``python -m faults.px4_tables`` runs the contract tests; with COVRECON_PX4_URLS set also on those vehicles.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

from agents.policies import policy_table

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "px4.md"
FEATURES = ROOT / "docs" / "px4.json"
EXPECTED = ("endpoint", "PX4")
"""Columns that are there though nothing was run on them: our vehicles, and the first of COVRECON_PX4_URLS."""
SHOWN = {"passed": "yes", "failed": "**no**", "skipped": "not run"}


def policies() -> str:
    """As a Markdown table."""
    rows = [f"| {name} | {when} | {then} | {lasts} |" for name, when, then, lasts in policy_table()]
    return "\n".join(["| policy | when | then | how long |", "|---|---|---|---|", *rows])


def features(matrix: dict[str, dict[str, str]]) -> str:
    """Features by backend, as a Markdown table."""
    backends = [*sorted(matrix), *(each for each in EXPECTED if not any(name.startswith(each) for name in matrix))]
    names = sorted({name for outcomes in matrix.values() for name in outcomes})
    rows = [
        f"| {name} | " + " | ".join(SHOWN[matrix.get(each, {}).get(name, "skipped")] for each in backends) + " |"
        for name in names
    ]
    return "\n".join(["| feature | " + " | ".join(backends) + " |", "|---" * (1 + len(backends)) + "|", *rows])


def fill(page: str, name: str, table: str) -> str:
    """``page`` with what lies between the comments ``name`` replaced."""
    start, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    return re.sub(f"{start}.*?{end}", lambda _: f"{start}\n{table}\n{end}", page, flags=re.DOTALL)


def main() -> int:
    FEATURES.unlink(missing_ok=True)
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "tests/contract/test_px4.py"],
        cwd=ROOT,
        env=os.environ | {"COVRECON_MATRIX": str(FEATURES)},
        check=False,
    )
    matrix = json.loads(FEATURES.read_text())
    page = fill(PAGE.read_text(), "policies", policies())
    PAGE.write_text(fill(page, "features", features(matrix)))
    return ran.returncode


if __name__ == "__main__":
    sys.exit(main())
