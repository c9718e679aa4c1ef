"""Mission files: TOML in, `Mission` out, and every fault of a file at once, each with the line to change."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from protocol.errors import MissionError
from protocol.formation import SPACING, Point, formation
from protocol.mission import Flight, Mission
from protocol.mission_faults import Fault, check
from protocol.toml_lines import KeyPath, key_lines, line_of

SIZE_MAX = 256 * 1024
"""Bytes; several times a mission that spells out every key for 255 drones."""

TEAM_MAX = 255
"""Drones; what ids allow."""


def load_mission(
    path: Path, *, drones: int | None = None, seed: int | None = None, replaced: Mapping[str, Any] | None = None
) -> Mission:
    """Read and check a mission: TOML, or JSON as `mission_to_json` writes it (``.json``).

    ``drones`` sets the team's size: the file's first drones, then more placed by `protocol.formation`. ``seed``
    replaces the file's, and ``replaced`` any others, by dotted name (``vehicles.kind``). A scene, a camera, weights or
    a folder of certificates given as a path becomes absolute, so that the mission may be stored elsewhere. Raises
    `MissionError` with one fault a line.
    """
    raw, lines = _parse(path, _read(path))
    if seed is not None:
        raw["seed"] = seed
    for name, value in (replaced or {}).items():
        _replace(raw, name, value)
    _resolve_scene(raw, path.parent)
    _resolve_cameras(raw, path.parent)
    _resolve_credentials(raw, path.parent)
    _resolve_weights(raw, path.parent)
    faults = _complete_team(raw, drones)
    mission, found = check(raw)
    faults += [fault for fault in found if fault.path not in {known.path for known in faults}]
    if mission is None or faults:
        faults.sort(key=lambda fault: line_of(lines, fault.path))
        raise MissionError([_sentence(path, lines, fault) for fault in faults])
    return mission.model_copy(update={"drones": mission.drones[:drones]})


def _replace(raw: dict[str, Any], name: str, value: Any) -> None:
    """Set one key, its table made if need be; what does not fit is found when the mission is checked."""
    *tables, key = name.split(".")
    for table in tables:
        below = raw.setdefault(table, {})
        if not isinstance(below, dict):
            return
        raw = below
    raw[key] = value


def mission_to_json(mission: Mission) -> str:
    """The effective mission, every default spelt out; loads back to an equal one."""
    return mission.model_dump_json(indent=2) + "\n"


def mission_to_toml(mission: Mission) -> str:
    """As `mission_to_json`, for people."""
    return "\n".join(_toml(mission.model_dump(mode="json"))) + "\n"


def mission_schema() -> str:
    """JSON schema of a mission file, for editors; `protocol/mission.schema.json` is this text."""
    schema = Mission.model_json_schema()
    schema["required"].remove("drones")  # the command line may place them
    return json.dumps(schema, indent=2) + "\n"


def _read(path: Path) -> str:
    try:
        if not path.is_file():
            what = "is not a file" if path.exists() else "no such file; missions/demo.toml is one to begin with"
            raise MissionError([f"{path}: {what}"])
        with path.open("rb") as file:
            content = file.read(SIZE_MAX + 1)
    except OSError as error:
        raise MissionError([f"{path}: cannot be read: {error.strerror}"]) from error
    if len(content) > SIZE_MAX:
        raise MissionError([f"{path}: larger than {SIZE_MAX // 1024} KiB, so not a mission"])
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        byte = content[error.start]
        raise MissionError([f"{path}:{line}: not a text file, byte 0x{byte:02x} is not UTF-8"]) from error


def _parse(path: Path, source: str) -> tuple[dict[str, Any], dict[KeyPath, int]]:
    try:
        if path.suffix == ".json":
            raw, lines = json.loads(source), {}
        else:
            raw, lines = tomllib.loads(source), key_lines(source)
    except RecursionError as error:
        raise MissionError([f"{path}: nested too deeply, so not a mission"]) from error
    except ValueError as error:  # not TOMLDecodeError alone: a number may have too many digits for Python
        place = re.search(r"\bline (\d+)", str(error))
        line = int(place[1]) if place else len(source.splitlines())
        raise MissionError([f"{path}:{line}: syntax: {error}"]) from error
    if not isinstance(raw, dict):
        raise MissionError([f"{path}:1: must hold a table of settings"])
    return raw, lines


def _resolve_scene(raw: dict[str, Any], folder: Path) -> None:
    table = raw.get("simulation")
    scene = table.get("scene") if isinstance(table, dict) else None
    if not isinstance(table, dict) or not isinstance(scene, str) or not scene:
        return
    path = (folder / Path(scene).expanduser()).resolve()
    if "/" in scene or path.suffix or path.exists():  # a built-in scene's name is a bare word
        table["scene"] = str(path)


def _resolve_cameras(raw: dict[str, Any], folder: Path) -> None:
    """Video files are named like scenes; URLs and devices stay."""
    drones = raw.get("drones")
    for drone in drones if isinstance(drones, list) else []:
        camera = drone.get("camera") if isinstance(drone, dict) else None
        if isinstance(camera, str) and camera and "://" not in camera:
            drone["camera"] = str((folder / Path(camera).expanduser()).resolve())


def _resolve_credentials(raw: dict[str, Any], folder: Path) -> None:
    table = raw.get("transport")
    credentials = table.get("credentials") if isinstance(table, dict) else None
    if isinstance(table, dict) and isinstance(credentials, str) and credentials:
        table["credentials"] = str((folder / Path(credentials).expanduser()).resolve())


def _resolve_weights(raw: dict[str, Any], folder: Path) -> None:
    table = raw.get("reconstruction")
    learned = table.get("learned") if isinstance(table, dict) else None
    weights = learned.get("weights") if isinstance(learned, dict) else None
    if isinstance(learned, dict) and isinstance(weights, str) and weights:
        learned["weights"] = str((folder / Path(weights).expanduser()).resolve())


def _complete_team(raw: dict[str, Any], drones: int | None) -> list[Fault]:
    """Append to ``raw["drones"]`` what it lacks of ``drones``."""
    own = raw.setdefault("drones", [])
    if drones is None:
        return [] if own else [Fault(("drones",), "none: add [[drones]] tables, or give their number (--drones)")]
    if not 1 <= drones <= TEAM_MAX:
        return [Fault(("drones",), f"a team has 1 to {TEAM_MAX}, not {drones}")]
    if not isinstance(own, list) or len(own) >= drones:
        return []
    wished = drones - len(own)
    starts = formation(_flight(raw), wished, _positions(own))
    used = {drone.get("id") for drone in own if isinstance(drone, dict)}
    free = (number for number in range(1, TEAM_MAX + 1) if number not in used)
    own += [{"id": number, "start": list(start)} for number, start in zip(free, starts, strict=False)]
    if len(starts) < wished:
        return [
            Fault(
                ("flight",),
                f"holds {len(own)} of {drones} drones in the start formation, "
                f"{SPACING} x separation_m apart: enlarge the region or place them with [[drones]]",
            )
        ]
    return []


def _flight(raw: dict[str, Any]) -> Flight:
    """The flight settings, or the default ones when they are faulty, which `check` says in its own words."""
    try:
        return Flight.model_validate_json(json.dumps(raw.get("flight", {}), default=str), strict=True)
    except ValidationError:
        return Flight()


def _positions(drones: list[Any]) -> list[Point]:
    """Where well-formed entries start."""
    starts = [drone.get("start") for drone in drones if isinstance(drone, dict)]
    return [
        (float(start[0]), float(start[1]), float(start[2]))
        for start in starts
        if isinstance(start, list) and len(start) >= 3 and all(isinstance(value, int | float) for value in start[:3])
    ]


def _sentence(path: Path, lines: Mapping[KeyPath, int], fault: Fault) -> str:
    place = f"{path}:{line_of(lines, fault.path)}" if lines else str(path)
    return ": ".join(part for part in (place, fault.key, fault.message) if part)


def _toml(table: Mapping[str, Any], path: tuple[str, ...] = ()) -> list[str]:
    """Lines of a table: its own values, then its tables and arrays of tables; what is None is left out."""
    plain = {key: value for key, value in table.items() if value is not None and not _is_tables(value)}
    lines = [f"{key} = {_toml_value(value)}" for key, value in plain.items()]
    for key, value in table.items():
        if _is_tables(value):
            name = ".".join((*path, key))
            elements = [value] if isinstance(value, dict) else value
            header = f"[{name}]" if isinstance(value, dict) else f"[[{name}]]"
            for element in elements:
                lines += ["", header, *_toml(element, (*path, key))]
    return lines


def _is_tables(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))


def _toml_value(value: Any) -> str:
    # JSON's numbers, booleans, lists and strings are TOML's, but for the one control character that only TOML escapes.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
