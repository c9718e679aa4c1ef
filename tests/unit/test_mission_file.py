from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from protocol.errors import MissionError
from protocol.guard import ROOT
from protocol.mission import Mission
from protocol.mission_file import SIZE_MAX, load_mission, mission_schema, mission_to_json, mission_to_toml

ONE_DRONE = "[[drones]]\nid = 1\nstart = [0, 1, 2, 0, 1.3]\n"


def write(folder: Path, text: str, name: str = "m.toml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def faults(folder: Path, text: str, **options: int) -> list[str]:
    """What is wrong with a mission of this text, the file's folder left out."""
    path = write(folder, text)
    with pytest.raises(MissionError) as caught:
        load_mission(path, **options)
    return [fault.removeprefix(f"{folder}/") for fault in caught.value.faults]


def test_a_minimal_mission_has_the_defaults(tmp_path: Path) -> None:
    mission = load_mission(write(tmp_path, ONE_DRONE))

    assert mission == Mission.model_validate({"drones": [{"id": 1, "start": (0, 1, 2, 0, 1.3)}]})


@pytest.mark.parametrize("path", sorted((ROOT / "missions").glob("*.toml")), ids=lambda path: path.name)
def test_a_shipped_mission_can_be_flown_and_names_its_schema(path: Path) -> None:
    load_mission(path)

    first = path.read_text().splitlines()[0]
    assert first.startswith("#:schema ")
    assert (path.parent / first.removeprefix("#:schema ")).resolve() == ROOT / "protocol" / "mission.schema.json"


def test_the_papers_mission_spells_out_the_defaults() -> None:
    paper = load_mission(ROOT / "missions" / "paper.toml")

    assert paper == Mission(name="paper", drones=paper.drones)


def test_all_faults_are_reported_at_once_each_with_its_line(tmp_path: Path) -> None:
    text = """\
name = "Bad Name"
duration_s = "300"
sed = 3
stop_below = 1.5
[flight]
speed_mx_mps = 0.5
separation_m = nan
[feedback]
method = "gird"
kappa = inf
[camera]
width_px = 320.5
[[drones]]
start = [0, 1, 2, 0]
"""
    assert faults(tmp_path, text) == [
        "m.toml:1: name: must match pattern '^[a-z0-9][a-z0-9_-]*$', got \"Bad Name\"",
        'm.toml:2: duration_s: must be a valid number, got "300"',
        "m.toml:3: sed: unknown key, did you mean seed?",
        "m.toml:4: stop_below: must be less than 1, got 1.5",
        "m.toml:6: flight.speed_mx_mps: unknown key, did you mean speed_max_mps?",
        "m.toml:7: flight.separation_m: must be a finite number, got nan",
        "m.toml:9: feedback.method: must be 'grid', 'm3c2' or 'none', got \"gird\"",
        "m.toml:10: feedback.kappa: must be a finite number, got inf",
        "m.toml:12: camera.width_px: must be a valid integer, got 320.5",
        "m.toml:13: drones.0.id: is missing",
        "m.toml:14: drones.0.start: has too few values, the one with index 4 is missing",
    ]


def test_faults_across_settings_are_reported_beside_the_others(tmp_path: Path) -> None:
    text = """\
sed = 3
duration_s = -1
drones = [
  { id = 1, start = [0, 1, 2, 0, 1.3] },
  { id = 1, start = [0.1, 1, 2, 0, 1.3] },
  { id = 3, start = [9, 1, 2, 0, 9] },
]
reconstruction = { nearest_m = 3, farthest_m = 2 }
"""
    assert faults(tmp_path, text) == [
        "m.toml:1: sed: unknown key, did you mean seed?",
        "m.toml:2: duration_s: must be greater than 0, got -1",
        "m.toml:3: drones: ids must differ, got [1, 1, 3]",
        "m.toml:5: drones.1.start: 0.10 m from drone 1, less than flight.separation_m 1",
        "m.toml:6: drones.2.start: [9.0, 1.0, 2.0] lies outside the flight region",
        "m.toml:6: drones.2.start: pitch 9 lies outside flight.pitch_limits_rad",
        "m.toml:8: reconstruction.nearest_m: must be less than farthest_m",
    ]


def test_a_faulty_region_does_not_make_good_starts_look_wrong(tmp_path: Path) -> None:
    text = '[flight]\nlower_m = [90, 90, 0]\nupper_m = [99, 99, "5"]\n[[drones]]\nid = 1\nstart = [95, 95, 2, 0, 1.3]\n'

    assert faults(tmp_path, text) == ['m.toml:3: flight.upper_m.2: must be a valid number, got "5"']


def test_a_key_in_the_wrong_table_is_told_where_it_belongs(tmp_path: Path) -> None:
    assert faults(tmp_path, "speed_max_mps = 1\n" + ONE_DRONE) == [
        "m.toml:1: speed_max_mps: unknown key, did you mean flight.speed_max_mps?"
    ]


def test_a_box_without_volume_is_refused_at_its_table(tmp_path: Path) -> None:
    text = "seed = 2\n[target]\nlower_m = [0, 0, 2]\n" + ONE_DRONE

    (fault,) = faults(tmp_path, text)

    assert fault.startswith("m.toml:2: target: upper_m (3.0, 3.0, 2.0) must exceed lower_m")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("a = 1\nb = = 2\n", "m.toml:2: syntax: Invalid value (at line 2, column 5)"),
        ("a = [1,\n2\n", "m.toml:2: syntax: Unclosed array (at end of document)"),
        ("a = 1\na = 2\n", "m.toml:2: syntax: Cannot overwrite a value (at line 2, column 6)"),
        ("a = " + "[" * 20_000, "m.toml: nested too deeply, so not a mission"),
        ("#" * (SIZE_MAX + 1), "m.toml: larger than 256 KiB, so not a mission"),
        ("when = 1979-05-27\n" + ONE_DRONE, "m.toml:1: when: must not be a date or time, got 1979-05-27"),
        ("drones = 3\n", "m.toml:1: drones: must be a valid array, got 3"),
        ("seed = true\n" + ONE_DRONE, "m.toml:1: seed: must be a valid integer, got true"),
        ("flight = 1\n" + ONE_DRONE, "m.toml:1: flight: must be an object, got 1"),
    ],
)
def test_one_fault_is_one_line(tmp_path: Path, text: str, fault: str) -> None:
    assert faults(tmp_path, text) == [fault]


def test_a_number_with_too_many_digits_is_a_fault_of_its_file(tmp_path: Path) -> None:
    (fault,) = faults(tmp_path, "seed = " + "9" * 5000 + "\n")

    assert fault.startswith("m.toml:1: syntax: ")


def test_a_file_that_is_not_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_bytes(b"a = 1\n\xff\xfe")

    with pytest.raises(MissionError, match=r"m\.toml:2: not a text file, byte 0xff is not UTF-8"):
        load_mission(path)


def test_a_missing_file_and_a_folder_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(MissionError, match=r"nothing\.toml: no such file"):
        load_mission(tmp_path / "nothing.toml")
    with pytest.raises(MissionError, match="is not a file"):
        load_mission(tmp_path)
    with pytest.raises(MissionError, match="cannot be read: File name too long"):
        load_mission(tmp_path / ("x" * 300))


def test_a_byte_order_mark_is_no_fault(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_bytes(b"\xef\xbb\xbf" + ONE_DRONE.encode())

    assert len(load_mission(path).drones) == 1


def test_a_mission_without_drones_needs_their_number(tmp_path: Path) -> None:
    (fault,) = faults(tmp_path, "seed = 2\n")
    assert fault == "m.toml:1: drones: none: add [[drones]] tables, or give their number (--drones)"

    mission = load_mission(write(tmp_path, "seed = 2\n"), drones=3)
    assert [drone.id for drone in mission.drones] == [1, 2, 3]
    assert mission.drones[0].start[:3] == (0.0, 1.0, 2.0)


@pytest.mark.parametrize("drones", [-1, 0, 256])
def test_an_impossible_team_size_is_refused(tmp_path: Path, drones: int) -> None:
    assert faults(tmp_path, ONE_DRONE, drones=drones) == [f"m.toml:1: drones: a team has 1 to 255, not {drones}"]


def test_the_files_own_drones_come_first_and_ids_stay_unique(tmp_path: Path) -> None:
    text = "[[drones]]\nid = 2\nstart = [0, 1, 2, 0, 1.3]\n[[drones]]\nid = 7\nstart = [3, 3, 1, 0.5, 1.2]\n"
    path = write(tmp_path, text)

    four = load_mission(path, drones=4).drones

    assert [drone.id for drone in four] == [2, 7, 1, 3]
    assert four[1].start == (3.0, 3.0, 1.0, 0.5, 1.2)
    assert load_mission(path, drones=1).drones == four[:1]


def test_a_team_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    (fault,) = faults(tmp_path, "[flight]\nseparation_m = 3\n", drones=9)

    assert fault.startswith("m.toml:1: flight: holds ")
    assert " of 9 drones in the start formation" in fault


def test_a_faulty_file_is_explained_also_when_the_team_is_to_be_completed(tmp_path: Path) -> None:
    text = "[flight]\nseparation_m = 0\n" + ONE_DRONE.replace("id = 1", 'id = "1"')

    assert faults(tmp_path, text, drones=3) == [
        "m.toml:2: flight.separation_m: must be greater than 0, got 0",
        'm.toml:4: drones.0.id: must be a valid integer, got "1"',
    ]


def test_a_given_seed_replaces_the_files(tmp_path: Path) -> None:
    assert load_mission(write(tmp_path, "seed = 5\n" + ONE_DRONE), seed=9).seed == 9
    assert faults(tmp_path, ONE_DRONE, seed=-1) == ["m.toml:1: seed: must be greater than or equal to 0, got -1"]


def test_a_scene_given_as_a_path_is_relative_to_the_mission_file(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    path = write(tmp_path, '[simulation]\nscene = "../hall.glb"\n' + ONE_DRONE, "sub/m.toml")

    assert load_mission(path).simulation.scene == str(tmp_path / "hall.glb")


def test_a_scene_given_by_name_stays_a_name(tmp_path: Path) -> None:
    path = write(tmp_path, '[simulation]\nscene = "warehouse"\n' + ONE_DRONE)

    assert load_mission(path).simulation.scene == "warehouse"


@pytest.mark.parametrize(("dump", "name"), [(mission_to_toml, "again.toml"), (mission_to_json, "again.json")])
def test_an_effective_mission_loads_back_equal(tmp_path: Path, dump: object, name: str) -> None:
    text = 'seed = 7\n[simulation]\nscene = "./a \\u00e4 \\u007f \\" b.ply"\n[target]\nyaw_rad = [0, 0.1]\n' + ONE_DRONE
    mission = load_mission(write(tmp_path, text), drones=4)
    assert callable(dump)

    again = load_mission(write(tmp_path, dump(mission), name))

    assert again == mission
    assert again.target.yaw_rad == (0.0, 0.1)


def test_a_faulty_effective_mission_is_refused_without_line_numbers(tmp_path: Path) -> None:
    path = write(tmp_path, json.dumps({"seed": -1, "drones": [{"id": 1, "start": [0, 1, 2, 0, 1.3]}]}), "m.json")
    with pytest.raises(MissionError) as caught:
        load_mission(path)
    assert caught.value.faults == (f"{path}: seed: must be greater than or equal to 0, got -1",)

    with pytest.raises(MissionError, match=r"m\.json:1: must hold a table of settings"):
        load_mission(write(tmp_path, "[]", "m.json"))
    with pytest.raises(MissionError, match=r"m\.json:2: syntax: "):
        load_mission(write(tmp_path, '{"seed": 1,\n', "m.json"))


def test_the_committed_schema_is_current() -> None:
    committed = (ROOT / "protocol" / "mission.schema.json").read_text()

    assert committed == mission_schema(), "covrecon mission schema > protocol/mission.schema.json"
    assert math.isclose(json.loads(committed)["$defs"]["Feedback"]["properties"]["kappa"]["default"], 4.0)


@pytest.mark.parametrize(
    ("named", "kept"),
    [("front.mp4", None), ("rtsp://10.0.0.2/live", "rtsp://10.0.0.2/live"), ("/dev/video0", "/dev/video0")],
)
def test_a_camera_that_is_a_file_is_named_relative_to_the_mission(tmp_path: Path, named: str, kept: str | None) -> None:
    text = f'[vehicles]\nkind = "px4"\n{ONE_DRONE}camera = "{named}"\n'
    assert load_mission(write(tmp_path, text)).drones[0].camera == (kept or str(tmp_path / "front.mp4"))


def test_a_camera_of_its_own_needs_a_vehicle_of_its_own(tmp_path: Path) -> None:
    with pytest.raises(MissionError, match="a real camera needs a real vehicle"):
        load_mission(write(tmp_path, ONE_DRONE + 'camera = "/dev/video0"\n'))


def test_two_drones_on_one_port_or_with_one_system_id_are_refused(tmp_path: Path) -> None:
    text = """
[vehicles]
kind = "px4"
[[drones]]
id = 1
start = [0.0, 0.0, 2.0, 0.0, 1.3]
url = "udpin://127.0.0.1:14541"
[[drones]]
id = 2
start = [2.0, 0.0, 2.0, 0.0, 1.3]
system_id = 1
[[drones]]
id = 3
start = [2.2, 0.0, 3.5, 0.0, 1.3]
"""
    with pytest.raises(MissionError) as refused:
        load_mission(write(tmp_path, text))
    said = str(refused.value)
    assert "udpin://127.0.0.1:14541 is drone 1's already" in said
    assert "system_id: 1 is drone 1's already" in said
    assert "0.20 m beside drone 2; to take off and land it takes 1.06 m" in said


def test_vehicles_may_be_chosen_on_the_command_line(tmp_path: Path) -> None:
    chosen = {"vehicles.kind": "px4", "vehicles.url": "udpin://127.0.0.1:20000"}
    mission = load_mission(write(tmp_path, ONE_DRONE), replaced=chosen, drones=2)
    assert [mission.vehicle_url(drone) for drone in mission.drones] == [
        "udpin://127.0.0.1:20000",
        "udpin://127.0.0.1:20001",
    ]
    with pytest.raises(MissionError, match="no connection with a port"):
        load_mission(write(tmp_path, ONE_DRONE), replaced={"vehicles.kind": "px4", "vehicles.url": "here"})
