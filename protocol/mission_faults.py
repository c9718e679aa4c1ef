"""What is wrong with a mission, all of it in one go, in words for the person who wrote the file."""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from protocol.formation import formation
from protocol.mission import Flight, Mission
from protocol.toml_lines import KeyPath

_SHOWN_MAX = 60
"""Characters of a refused value that a message repeats."""


@dataclass(frozen=True, slots=True)
class Fault:
    path: KeyPath
    message: str
    spoils_value: bool = True
    """False for an unknown key: the settings around it still hold."""

    @property
    def key(self) -> str:
        return ".".join(str(part) for part in self.path)


def check(raw: dict[str, Any]) -> tuple[Mission | None, list[Fault]]:
    """The mission that ``raw`` (tables, lists, numbers, strings) describes, or every fault found.

    Pydantic leaves out rules across settings (drones too close, say) while any single setting is faulty. So a faulty
    ``raw`` is checked again with what was faulty taken out.
    """
    faults = list(_unusable(raw, ()))
    seen = {fault.path for fault in faults}
    mission, found = _validate(raw)
    faults += [fault for fault in found if fault.path not in seen]
    if faults:
        _, across = _validate(_without(raw, faults))
        faults += [fault for fault in across if fault not in faults]
    return (None if faults else mission), faults


def _unusable(value: Any, path: KeyPath) -> Iterator[Fault]:
    """Values that TOML has and JSON, by which pydantic is strict, has not."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _unusable(item, (*path, key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _unusable(item, (*path, index))
    elif isinstance(value, float) and not math.isfinite(value):
        yield Fault(path, f"must be a finite number, got {value}")
    elif not isinstance(value, str | bool | int | float | None):
        yield Fault(path, f"must not be a date or time, got {value}")


def _validate(raw: dict[str, Any]) -> tuple[Mission | None, list[Fault]]:
    try:
        # Through JSON: strict mode refuses "300" for a number, and would refuse TOML's lists for tuples.
        return Mission.model_validate_json(json.dumps(raw, default=str), strict=True), []
    except ValidationError as error:
        return None, [fault for details in error.errors(include_url=False) for fault in _faults(details)]


def _without(raw: dict[str, Any], faults: list[Fault]) -> dict[str, Any]:
    """A copy with unknown keys taken out and each table that holds a faulty value left to its defaults."""
    rest: dict[str, Any] = json.loads(json.dumps(raw, default=str))
    spoilt = {fault.path[0] for fault in faults if fault.spoils_value and fault.path}
    if spoilt & {"flight", "drones"}:
        # Where drones start can be judged only when both hold.
        spoilt |= {"flight", "drones"}
    for fault in faults:
        if not fault.spoils_value and fault.path[0] not in spoilt:
            table: Any = rest
            for part in fault.path[:-1]:
                table = table[part]
            del table[fault.path[-1]]
    for name in spoilt:
        rest.pop(str(name), None)
    if "drones" not in rest:
        rest["drones"] = [{"id": 1, "start": formation(Flight(), 1)[0]}]
    return rest


def _faults(details: ErrorDetails) -> Iterator[Fault]:
    path = tuple(details["loc"])
    match details["type"]:
        case "extra_forbidden":
            yield Fault(path, "unknown key" + _suggestion(path), spoils_value=False)
        case "missing" if isinstance(path[-1], int):
            yield Fault(path[:-1], f"has too few values, the one with index {path[-1]} is missing")
        case "missing":
            yield Fault(path, "is missing")
        case "too_short" if len(details["input"]) >= details["ctx"]["min_length"]:
            return  # too few only because faulty ones, told on their own, do not count
        case "value_error":
            # `Mission` checks the whole team in one validator: a line for each fault, opened by its key.
            for line in str(details["ctx"]["error"]).splitlines():
                key, separator, message = line.partition(": ")
                if path or not separator:
                    yield Fault(path, line)
                else:
                    yield Fault(tuple(int(part) if part.isdigit() else part for part in key.split(".")), message)
        case _:
            shown = json.dumps(details["input"], default=str, ensure_ascii=False)
            shown = shown if len(shown) <= _SHOWN_MAX else shown[:_SHOWN_MAX] + "..."
            yield Fault(path, f"{re.sub(r'^[A-Z][a-z]+ should', 'must', details['msg'])}, got {shown}")


def _suggestion(path: KeyPath) -> str:
    tables = _tables(Mission)
    table = tuple(str(part) for part in path[:-1] if not isinstance(part, int))
    name = str(path[-1])
    near = difflib.get_close_matches(name, tables.get(table, []), n=1)
    if near:
        return f", did you mean {near[0]}?"
    elsewhere = [".".join((*other, name)) for other, names in tables.items() if name in names and other != table]
    return f", did you mean {' or '.join(elsewhere)}?" if elsewhere else ""


def _tables(model: type[BaseModel], path: tuple[str, ...] = ()) -> dict[tuple[str, ...], list[str]]:
    """The keys of every table, by the table's path without indices."""
    tables = {path: list(model.model_fields)}
    for name, field in model.model_fields.items():
        for kind in (field.annotation, *get_args(field.annotation)):
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                tables |= _tables(kind, (*path, name))
    return tables
