"""docs/benchmarks.md says of every benchmark what it means."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from faults.benchmarks_page import GROWTH, PAGE, PICTURE, entry_of, page, write

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def row(name: str, ratio: float, **more: Any) -> dict[str, Any]:
    return {"name": name, "value": 2.5, "unit": "ms CPU", "against": "it", "ratio": ratio} | {
        "day": "2026-01-01", "machine": "a machine", **more
    }  # fmt: skip


def recorded_names() -> Iterator[str]:
    """First arguments of ``record`` in all benchmarks, with x for what is computed."""
    for file in BENCHMARKS.glob("test_*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "record":
                match node.args[0]:
                    case ast.Constant(value=str(name)):
                        yield name
                    case ast.JoinedStr(values=parts):
                        yield "".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in parts)
                    case other:
                        raise AssertionError(ast.dump(other))


def test_every_benchmark_is_explained() -> None:
    names = set(recorded_names())
    assert {"field_tick_15e6", "qp_solve", "lockstep_flight_4", "setpoint_p50_x"} <= names
    assert [name for name in sorted(names) if entry_of(name)[0] == "Others"] == []


def test_a_figure_below_its_bar_stands_out_and_one_above_does_not() -> None:
    told = page([row("qp_solve", 19.9), row("field_tick_15e6", 300.0)])
    assert "| it | **19.9** | 20 |" in told
    assert "| it | 300 | 300 |" in told


def test_where_and_when_it_was_measured_is_said() -> None:
    told = page([row("qp_solve", 30.0), row("memory_agent", 2.0), row("memory_agent", 2.0, day="2026-01-02")])
    assert "- 2 entries on 2026-01-01: a machine\n- 1 entries on 2026-01-02: a machine" in told


def test_the_picture_is_there_when_both_curves_are(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    write([row("qp_solve", 30.0)], tmp_path)
    assert "field-growth" not in (tmp_path / PAGE).read_text()
    assert not (tmp_path / PICTURE).exists()

    rows = [row(name, 1.0, curve=[[1, 2.0], [16, 20.0]]) for name in GROWTH]
    write(rows, tmp_path)
    assert "images/field-growth.svg" in (tmp_path / PAGE).read_text()
    drawn = (tmp_path / PICTURE).read_bytes()
    assert b"<svg" in drawn
    write(rows, tmp_path)
    assert (tmp_path / PICTURE).read_bytes() == drawn
