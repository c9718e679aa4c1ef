"""What is shipped to start the processes elsewhere passes the checker of its kind, and the checkers find faults."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from deploy.cli import app
from faults.sandbox import settings_of
from protocol.guard import PACKAGES, ROOT
from protocol.mission_file import load_mission
from protocol.process import parse

DEPLOY = ROOT / "deploy"
DOCKERFILE, COMPOSE, FLEET = DEPLOY / "docker" / "Dockerfile", DEPLOY / "compose.yaml", ROOT / "missions" / "fleet.toml"
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
EXPOSURE_MAX = 30
"""Of systemd's 100, ten times what it prints: "OK" ends at 4."""
MODULES = {
    "router": "protocol.router",
    "ground": "ground_station",
    "sim": "sim_bridge",
    "agent": "agents",
    "console": "ground_station.console",
}
"""Of the commands that start one process."""
LEARNED, MAP = "torch", ("open3d", "open3d-cpu")
"""What a drone must not have to carry."""

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed (Debian: systemd)"
)


def run(*command: str | Path) -> tuple[int, str]:
    """Exit code, and all that was said."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def tool(name: str) -> Path:
    """A program that came with the dev group."""
    return Path(sys.executable).with_name(name)


def arguments_are_understood(command: list[str]) -> None:
    """By the process that ``command``, without the word covrecon, starts."""
    places = {"--mission": str(FLEET)}
    given = [places.get(before, word) for before, word in zip(["", *command], command, strict=False)]
    parse(MODULES[given[0]], [*given[1:], "--endpoint", "tcp/127.0.0.1:7447"])


# --- docker -----------------------------------------------------------------------------------------------------------


def lint(dockerfile: Path) -> tuple[int, str]:
    return run(tool("hadolint"), "--no-color", dockerfile)


def test_hadolint_has_nothing_to_say_of_the_dockerfile() -> None:
    assert lint(DOCKERFILE) == (0, "")


def test_hadolint_finds_a_planted_fault(tmp_path: Path) -> None:
    planted = tmp_path / "Dockerfile"
    planted.write_text(DOCKERFILE.read_text() + "\nRUN sudo apt-get install -y curl\n")

    code, said = lint(planted)
    assert code != 0
    assert "DL3004" in said  # sudo


def test_every_image_is_healthy_or_not_and_runs_as_nobody_in_particular() -> None:
    stages: dict[str, list[str]] = {}
    parents: dict[str, str] = {}
    for line in DOCKERFILE.read_text().splitlines():
        if named := re.fullmatch(r"FROM (\S+) AS (\S+)", line):
            stage = named[2]
            stages[stage], parents[stage] = [], named[1]
        elif stages:
            stages[stage].append(line)

    for image in ("drone", "ground", "learned"):
        lines, stage = list(stages[image]), image
        while (stage := parents[stage]) in stages:
            lines += stages[stage]
        users = [line for line in stages[image] if line.startswith("USER")]
        assert users == ["USER 10001:10001"]
        assert any(line.startswith("HEALTHCHECK") for line in lines)


def test_the_images_hold_our_packages_and_no_secrets() -> None:
    copied = re.findall(r"^COPY (\w+) /opt/covrecon/\w+$", DOCKERFILE.read_text(), re.MULTILINE)
    assert set(copied) == {*PACKAGES, "missions"}

    lines = (ROOT / ".dockerignore").read_text().splitlines()
    ignored = [line for line in lines if line and not line.startswith("#")]
    assert ignored[0] == "*"
    assert {line[1:] for line in ignored if line.startswith("!")} >= set(copied)
    assert {"missions/pki", "**/*.key", "**/*.pem"} <= set(ignored)


def test_the_health_check_tells_a_young_heartbeat_from_an_old_one_and_from_none(tmp_path: Path) -> None:
    command = re.search(r'CMD \["sh", "-c", "(.*)"\]', DOCKERFILE.read_text())
    assert command is not None
    alive = tmp_path / "alive"
    check = ["env", f"COVRECON_HEARTBEAT={alive}", "sh", "-c", command[1].replace('\\"', '"')]

    assert run(*check)[0] != 0
    alive.touch()
    assert run(*check)[0] == 0
    assert run("touch", "--date=-1 minute", alive)[0] == 0
    assert run(*check)[0] != 0


# --- compose ----------------------------------------------------------------------------------------------------------


def services(text: str | None = None) -> dict[str, dict[str, Any]]:
    loaded: dict[str, dict[str, Any]] = yaml.safe_load(text or COMPOSE.read_text())["services"]
    return loaded


def validate(file: Path) -> tuple[int, str]:
    return run(tool("check-jsonschema"), "--builtin-schema", "vendor.compose-spec", file)


def test_the_compose_file_fits_composes_schema() -> None:
    code, said = validate(COMPOSE)
    assert code == 0, said


def test_composes_schema_finds_a_planted_fault(tmp_path: Path) -> None:
    planted = tmp_path / "compose.yaml"
    planted.write_text(COMPOSE.read_text().replace("read_only: true", "read_only: {}", 1))

    code, said = validate(planted)
    assert code != 0
    assert "read_only" in said


@pytest.mark.parametrize("name", services())
def test_a_container_has_no_more_rights_than_it_needs(name: str) -> None:
    service = services()[name]

    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["mem_limit"]
    assert service["pids_limit"]
    assert all(port.startswith("127.0.0.1:") for port in service.get("ports", []))
    assert all(volume.endswith(":ro") for volume in service["volumes"] if volume.startswith("."))
    assert service["stop_grace_period"]
    assert service["restart"] == ("no" if name == "sim" else "on-failure")


@pytest.mark.parametrize("name", services())
def test_a_container_sees_the_keys_of_itself_alone(name: str) -> None:
    keys = [Path(volume.split(":")[0]).stem for volume in services()[name]["volumes"] if ".key:" in volume]

    assert keys == [{"console": "operator-console"}.get(name, name)]


@pytest.mark.parametrize("name", services())
def test_a_containers_command_is_understood_by_its_process(name: str) -> None:
    arguments_are_understood([re.sub(r"\$\{\w+:-(.*?)\}", r"\1", word) for word in services()[name]["command"]])


def test_the_compose_file_flies_the_fleets_mission() -> None:
    mission = load_mission(FLEET)
    everybody = services()

    assert {name for name in everybody if name.startswith("drone-")} == {f"drone-{one.id}" for one in mission.drones}
    assert mission.transport.endpoint == "tls/router:7447"
    assert "router" in everybody
    assert str(mission.console.port) == everybody["console"]["ports"][0].rpartition(":")[2]
    for name, service in everybody.items():
        assert name == "router" or service["depends_on"]["router"] == {"condition": "service_healthy"}
        assert service["build"]["target"] == ("drone" if name.startswith(("drone", "router")) else "ground")


# --- systemd ----------------------------------------------------------------------------------------------------------


def placed(unit: Path, folder: Path, *, more: str = "") -> Path:
    """A copy of ``unit`` whose program exists here, ``more`` added to [Service]."""
    copy = folder / unit.name
    text = unit.read_text().replace("/opt/covrecon/venv/bin/covrecon", "/bin/true")
    copy.write_text(text.replace("[Service]\n", f"[Service]\n{more}\n"))
    return copy


def settings(unit: Path) -> dict[str, str]:
    """The last value of each setting."""
    lines = (line.partition("=") for line in unit.read_text().splitlines() if re.match(r"[A-Z]\w*=", line))
    return {name: value for name, _, value in lines}


def unit_of(process: str) -> Path:
    (unit,) = (unit for unit in UNITS if unit.stem.rstrip("@") == f"covrecon-{process}")
    return unit


def test_every_process_of_a_fleet_has_a_unit() -> None:
    assert [unit.name for unit in UNITS] == [
        "covrecon-console@.service",
        "covrecon-drone@.service",
        "covrecon-ground@.service",
        "covrecon-observer@.service",
        "covrecon-router.service",
    ]


@needs_systemd
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_systemd_understands_the_unit(unit: Path, tmp_path: Path) -> None:
    assert run("systemd-analyze", "verify", placed(unit, tmp_path)) == (0, "")  # it ends with 0 whatever it finds


@needs_systemd
@pytest.mark.parametrize("fault", ["Restrt=always", "WatchdogSec=soon", "ExecStartPre=/nowhere/program"])
def test_systemd_finds_a_planted_fault(fault: str, tmp_path: Path) -> None:
    _, said = run("systemd-analyze", "verify", placed(UNITS[0], tmp_path, more=fault))
    assert said


@needs_systemd
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_a_unit_exposes_little(unit: Path, tmp_path: Path) -> None:
    code, said = run(*security(placed(unit, tmp_path)))
    assert code == 0, said


@needs_systemd
def test_a_unit_that_is_not_hardened_exposes_much(tmp_path: Path) -> None:
    bare = tmp_path / "bare.service"
    bare.write_text("[Service]\nExecStart=/bin/true\n")
    assert run(*security(bare))[0] != 0


def security(unit: Path) -> list[str | Path]:
    return ["systemd-analyze", "security", "--offline=true", f"--threshold={EXPOSURE_MAX}", unit]


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_a_units_command_is_understood_by_its_process(unit: Path) -> None:
    program, *command = settings(unit)["ExecStart"].replace("%i", "3").split()

    assert program == "/opt/covrecon/venv/bin/covrecon"
    arguments_are_understood(command)


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_a_unit_is_watched_and_started_again(unit: Path) -> None:
    told = settings(unit)

    assert told["Type"] == "notify"
    assert told["WatchdogSec"]
    assert told["Restart"] == "on-failure"
    assert told["StartLimitBurst"]
    assert told["SuccessExitStatus"] == "143"  # ended as it was asked to
    assert told["User"] == "covrecon"
    assert told["Environment"].startswith("PYTHONPATH=/opt/covrecon ")
    assert told["EnvironmentFile"] == "-/etc/covrecon/environment"


@pytest.mark.parametrize("process", ["ground", "observer", "console"])
def test_what_serves_one_flight_keeps_to_its_folder_and_gives_up_on_bad_input(process: str) -> None:
    told = settings(unit_of(process))

    assert told["StateDirectory"] == "covrecon/%i"
    assert told["ExecStart"].endswith("--run /var/lib/covrecon/%i")
    assert told["RestartPreventExitStatus"] == "2"


def test_a_drone_that_waits_for_its_router_is_never_given_up() -> None:
    """It ends with 2 when nobody answers in 30 s, as when its mission is wrong: only the pace tells them apart."""
    told = settings(unit_of("drone"))
    connecting_s, refused_s = 30.0, 5.0
    restart_s, interval_s, burst = (
        float(told[name]) for name in ("RestartSec", "StartLimitIntervalSec", "StartLimitBurst")
    )

    assert "RestartPreventExitStatus" not in told
    assert burst * (connecting_s + restart_s) > interval_s
    assert burst * (refused_s + restart_s) < interval_s


def test_the_router_reads_its_certificates_again_on_reload() -> None:
    assert settings(unit_of("router"))["ExecReload"] == "/bin/kill -HUP $MAINPID"
    assert int(settings(unit_of("router"))["LimitNOFILE"]) >= 16384


@pytest.mark.skipif(shutil.which("systemd-sysusers") is None, reason="systemd-sysusers is not installed")
def test_systemd_makes_the_units_user(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    code, said = run("systemd-sysusers", f"--root={tmp_path}", DEPLOY / "systemd" / "covrecon.sysusers")

    assert code == 0, said
    assert (tmp_path / "etc" / "passwd").read_text().startswith("covrecon:x:")


def test_all_units_filter_the_same_calls() -> None:
    """`tests/integration/test_confined.py` flies under one of them."""
    for name in ("SystemCallFilter", "RestrictAddressFamilies", "SystemCallErrorNumber"):
        assert len({tuple(settings_of(unit, name)) for unit in UNITS}) == 1


# --- what a drone installs --------------------------------------------------------------------------------------------


def closure(extra: str) -> set[str]:
    """All that ``pip install 'coverage-recon[extra]'`` installs here."""
    found: set[str] = set()
    waiting = [Requirement(f"coverage-recon[{extra}]")]
    while waiting:
        wanted = waiting.pop()
        name = canonicalize_name(wanted.name)
        extras = {"", *wanted.extras}
        if name in found and not wanted.extras:
            continue
        found.add(name)
        try:
            told = metadata.requires(wanted.name) or []
        except metadata.PackageNotFoundError:  # an extra's, which this environment lacks
            continue
        parts = (Requirement(part) for part in told)
        waiting += [
            part for part in parts if part.marker is None or any(part.marker.evaluate({"extra": one}) for one in extras)
        ]
    return found


def test_a_drone_installs_neither_open3d_nor_torch() -> None:
    drone = closure("")

    assert {"eclipse-zenoh", "mavsdk", "llvmlite", "pydantic-core"} <= drone
    assert not drone & {LEARNED, *MAP}


def test_the_extras_would_bring_them() -> None:
    assert closure("ground") & set(MAP)
    assert LEARNED in closure("learned")


# --- the guide --------------------------------------------------------------------------------------------------------


def test_the_guides_commands_are_those_of_the_command_line() -> None:
    known = {name for name in app if not name.startswith("-")}
    pages = [ROOT / "docs" / "fleet.md", COMPOSE, FLEET, *UNITS]
    used = {
        found for page in pages for found in re.findall(r"(?:bin/|[`# ])covrecon ([a-z][a-z0-9-]*)", page.read_text())
    }

    assert used >= {"pki", "command", "doctor", "mission"}
    assert used <= known


def test_the_guide_names_units_and_files_that_there_are() -> None:
    guide = (ROOT / "docs" / "fleet.md").read_text()

    assert set(re.findall(r"covrecon-(?:router|\w+(?=@))", guide)) == {unit.stem.rstrip("@") for unit in UNITS}
    files = re.findall(r"\b(?:deploy|missions|tests)/[\w/.-]+\w", guide)
    assert files
    assert not [file for file in files if not (ROOT / file).exists()]
