"""What the doctor says of computers that are well and of those that are not."""

from __future__ import annotations

import errno
import json
import os
import signal
import socket
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cyclopts import App

from deploy.doctor import examination, libraries, machine
from deploy.doctor.certificates import check_certificates
from deploy.doctor.clock import ClockState, check_clock, read_clock
from deploy.doctor.finding import Finding
from deploy.doctor.gpu import LIST_GPUS, check_gpu
from deploy.doctor.inputs import check_inputs
from deploy.doctor.libraries import check_libraries, load, remedy, required_libraries
from deploy.doctor.network import check_network
from deploy.doctor.ports import Place, check_place, places
from deploy.doctor_command import doctor
from deploy.pki.authority import init, renew
from protocol.map_settings import Reconstruction
from protocol.mission import Drone, Mission, Transport
from protocol.operation_settings import Console, Metrics, Recording
from protocol.vehicle_settings import Vehicles

PAIR = (Drone(id=1, start=(0, 1.5, 2, 0, 1.4)), Drone(id=4, start=(0, -1.5, 2, 0, 1.4)))
MISSION = Mission(drones=PAIR)
KNOWN = ClockState(synchronised=True, offset_s=-0.0002, error_max_s=0.003, time_s=0.0)


def levels(findings: Iterator[Finding]) -> dict[str, str]:
    return {finding.subject: finding.level for finding in findings}


# --- clock ---------------------------------------------------------------------------------------------------------


def test_the_kernels_clock_is_read_in_its_own_layout() -> None:
    before = time.clock_gettime(time.CLOCK_REALTIME)
    state = read_clock()

    assert before - 1e-6 <= state.time_s <= time.clock_gettime(time.CLOCK_REALTIME)
    assert 0 <= state.error_max_s <= 3600


@pytest.mark.parametrize(
    ("state", "level", "text"),
    [
        (KNOWN, "ok", "synchronised, off by -0.200 ms, at most 3 ms"),
        (ClockState(True, 0.0, 0.5, 0.0), "warn", "at most 500 ms"),
        (ClockState(True, -0.3, 0.05, 0.0), "warn", "off by -300.000 ms"),
        (ClockState(False, 0.0, 16.0, 0.0), "warn", "not synchronised"),
        (PermissionError(errno.EPERM, "Operation not permitted"), "warn", "does not say (Operation not permitted)"),
    ],
)
def test_a_clock_that_may_be_off_is_told_with_what_to_do(state: ClockState | OSError, level: str, text: str) -> None:
    finding = check_clock(state)

    assert finding.level == level
    assert text in finding.text
    assert bool(finding.advice) == (level == "warn")


# --- GPU -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gpus", "torch", "has_torch", "level", "text"),
    [
        ("", "", False, "ok", "none found; not needed"),
        ("H200, 143771 MiB, 570.1", "", False, "ok", "H200, 143771 MiB, 570.1; not needed"),
        ("H200", "True 2.13.0", True, "ok", "H200; torch 2.13.0"),
        ("H200", "False 2.13.0+cpu", True, "warn", "torch 2.13.0+cpu cannot use it"),
        ("H200", "", True, "warn", "torch (cannot be loaded) cannot use it"),
        ("", "False 2.13.0+cpu", True, "ok", "none found; torch 2.13.0+cpu"),
    ],
)
def test_a_gpu_is_never_needed(gpus: str, torch: str, level: str, text: str, *, has_torch: bool) -> None:
    def answer(command: Sequence[str]) -> str:
        return gpus if command == LIST_GPUS else torch

    finding = check_gpu(answer, has_torch=has_torch)

    assert finding.level == level
    assert text in finding.text


# --- libraries -----------------------------------------------------------------------------------------------------


def project(root: Path, dependencies: Sequence[str], **extras: Sequence[str]) -> Path:
    lines = ["[project]", f"dependencies = {json.dumps(dependencies)}", "[project.optional-dependencies]"]
    lines += [f"{extra} = {json.dumps(names)}" for extra, names in extras.items()]
    (root / "pyproject.toml").write_text("\n".join(lines))
    return root


def findings(root: Path, needed: dict[str, str] | None = None) -> dict[str, Finding]:
    return {finding.subject: finding for finding in check_libraries(required_libraries(root), needed or {})}


@pytest.fixture
def all_load(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libraries, "load", lambda modules: dict.fromkeys(modules, ""))


@pytest.mark.usefixtures("all_load")
def test_a_library_that_is_there_and_new_enough_needs_no_line_of_its_own(tmp_path: Path) -> None:
    found = findings(project(tmp_path, ["numpy>=2.0", "eclipse-zenoh>=1.10"]))

    assert list(found) == ["libraries"]
    assert found["libraries"].level == "ok"


@pytest.mark.usefixtures("all_load")
def test_a_library_that_is_missing_or_too_old_is_told_with_what_is_needed(tmp_path: Path) -> None:
    found = findings(project(tmp_path, ["numpy>=99", "no-such-library>=1.2", "rich"]))

    assert {name: finding.level for name, finding in found.items()} == {"numpy": "fail", "no-such-library": "fail"}
    assert found["numpy"].text.endswith("but >=99 is needed")
    assert found["no-such-library"].text == "not installed; >=1.2 is needed"
    assert found["numpy"].advice == "run: make install"


@pytest.mark.usefixtures("all_load")
def test_a_library_for_another_kind_of_computer_is_not_asked_for(tmp_path: Path) -> None:
    found = findings(project(tmp_path, ["rich", "no-such-library; sys_platform == 'win32'"]))

    assert {name: finding.level for name, finding in found.items()} == {"libraries": "ok"}


@pytest.mark.usefixtures("all_load")
def test_a_set_that_nobody_needs_may_be_missing_and_one_that_the_mission_needs_may_not(tmp_path: Path) -> None:
    root = project(tmp_path, ["rich"], camera=["no-such-camera"], half=["numpy", "no-such-half"])

    assert findings(root)["libraries [camera]"].level == "ok"
    needed = findings(root, {"camera": "the mission has real cameras"})["libraries [camera]"]
    assert (needed.level, needed.text) == ("fail", "not installed, but the mission has real cameras")
    assert findings(root)["no-such-half"].level == "fail"


def test_an_installed_copy_asks_its_own_metadata(tmp_path: Path) -> None:
    known = {library.requirement.name: library.extra for library in required_libraries(tmp_path)}

    assert known["numpy"] == ""
    assert known["matplotlib"] == "ground"
    assert known["opencv-python-headless"] == "camera"


@pytest.mark.light
def test_libraries_are_loaded_where_they_can_do_no_harm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modules = {
        "talks": "print('covrecon is a word')",
        "unlinked": "raise ImportError('libGL.so.1: cannot open shared object file: No such file or directory')",
        "dies": "import os\nos.kill(os.getpid(), 9)",
        "leaves": "raise SystemExit(3)",
        "hangs": "while True: pass",
        "fine": "",
    }
    for name, source in modules.items():
        (tmp_path / f"{name}.py").write_text(source)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    assert load([*modules, "absent"], timeout_s=2.0) == {
        "talks": "",
        "unlinked": "ImportError: libGL.so.1: cannot open shared object file: No such file or directory",
        "dies": f"its process was killed by {signal.SIGKILL.name}",
        "leaves": "SystemExit: 3",
        "hangs": "not loaded after 2 s",
        "fine": "",
        "absent": "ModuleNotFoundError: No module named 'absent'",
    }


@pytest.mark.parametrize(
    ("fault", "advice"),
    [
        ("OSError: libEGL.so.1: cannot open shared object file", "apt-get install -y --no-install-recommends libegl1"),
        ("ImportError: libusb-1.0.so.0: cannot open", "apt-get install -y --no-install-recommends libusb-1.0-0"),
        ("ImportError: libcuda.so.1: cannot open", "the system's package that holds libcuda.so.1"),
        ("its process was killed by SIGILL", "make clean install"),
    ],
)
def test_a_library_that_cannot_be_loaded_comes_with_its_remedy(fault: str, advice: str) -> None:
    assert advice in remedy(fault)


# --- ports ---------------------------------------------------------------------------------------------------------


def listening(kind: socket.SocketKind) -> socket.socket:
    taken = socket.socket(socket.AF_INET, kind)
    taken.bind(("127.0.0.1", 0))
    if kind == socket.SOCK_STREAM:
        taken.listen()
    return taken


def test_the_places_of_a_mission_are_where_its_processes_will_listen() -> None:
    drones = (PAIR[0], PAIR[1].model_copy(update={"url": "serial:///dev/ttyACM0:57600"}))
    mission = MISSION.model_copy(
        update={
            "drones": drones,
            "transport": Transport(endpoint="tcp/[::1]:7447"),
            "recording": Recording(foxglove_port=8765),
            "metrics": Metrics(port=9100),
            "vehicles": Vehicles(kind="px4"),
        }
    )

    found = {place.who: (place.transport, place.host, place.port) for place in places(mission)}
    assert found == {
        "router": ("tcp", "::1", 7447),
        "console": ("tcp", "127.0.0.1", 8080),
        "foxglove": ("tcp", "127.0.0.1", 8765),
        "metrics of ground": ("tcp", "127.0.0.1", 9100),
        "metrics of sim": ("tcp", "127.0.0.1", 9101),
        "metrics of drone 1": ("tcp", "127.0.0.1", 9102),
        "metrics of drone 4": ("tcp", "127.0.0.1", 9105),
        "PX4 of drone 1": ("udp", "127.0.0.1", 14540),
    }


def test_a_mission_that_listens_nowhere_has_no_places() -> None:
    assert not list(places(MISSION.model_copy(update={"console": Console(port=0)})))


@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM])
def test_a_port_that_is_taken_is_told_with_who_has_it(kind: socket.SocketKind) -> None:
    transport = "tcp" if kind == socket.SOCK_STREAM else "udp"
    with listening(kind) as taken:
        place = Place("console", transport, "127.0.0.1", taken.getsockname()[1], "console.port")
        finding = check_place(place)

        assert finding.level == "fail"
        assert f"127.0.0.1:{place.port} is taken by process {os.getpid()} (" in finding.text
        assert "console.port" in finding.advice
    assert check_place(place).level == "ok"


@pytest.mark.parametrize(("host", "port"), [("192.0.2.1", 8080), ("no-such-host.invalid", 8080), ("127.0.0.1", 70000)])
def test_a_place_that_cannot_be_is_told_with_the_key_to_change(host: str, port: int) -> None:
    finding = check_place(Place("router", "tcp", host, port, "transport.endpoint"))

    assert finding.level == "fail"
    assert "transport.endpoint" in finding.advice


# --- network -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("endpoint", "host", "transport", "console"),
    [
        ("", "127.0.0.1", "ok", "ok"),
        ("tcp/127.0.0.1:7447", "::1", "ok", "ok"),
        ("tcp/localhost:7447", "localhost", "ok", "ok"),
        ("tcp/0.0.0.0:7447", "0.0.0.0", "fail", "warn"),  # noqa: S104
        ("tcp/ground.example:7447", "192.168.1.5", "fail", "warn"),
        ("ws/10.0.0.1:7447", "127.0.0.1", "fail", "ok"),
        ("quic/127.0.0.1:7447", "127.0.0.1", "fail", "ok"),
        ("tls/10.0.0.1:7447", "127.0.0.1", "ok", "ok"),
        ("tls/127.0.0.1:7447", "127.0.0.1", "ok", "ok"),
        ("unixsock-stream//run/user/1000/z.sock", "127.0.0.1", "ok", "ok"),
        ("tpc/127.0.0.1:7447", "127.0.0.1", "fail", "ok"),
        ("127.0.0.1:7447", "127.0.0.1", "fail", "ok"),
    ],
)
def test_who_can_be_reached_from_elsewhere_is_told(endpoint: str, host: str, transport: str, console: str) -> None:
    mission = MISSION.model_copy(update={"transport": Transport(endpoint=endpoint), "console": Console(host=host)})
    found = list(check_network(mission))

    assert levels(iter(found)) == {"transport": transport, "console": console}
    assert all(finding.advice for finding in found if finding.level != "ok")


def test_an_endpoint_without_encryption_is_refused_with_what_to_write_instead() -> None:
    mission = MISSION.model_copy(update={"transport": Transport(endpoint="tcp/10.0.0.1:7447")})

    finding = next(check_network(mission))
    assert finding.text.startswith("refused: tcp/10.0.0.1:7447 would be open to other computers, without encryption")
    assert finding.advice.startswith("transport.endpoint: write tls/10.0.0.1:7447 and set transport.credentials")


def test_other_routers_are_judged_by_the_same_measure() -> None:
    transport = Transport(alternatives=("tls/10.0.0.2:7447", "tcp/10.0.0.3:7447"), uplinks=("tcp/10.1.0.1:7447",))
    found = levels(check_network(MISSION.model_copy(update={"transport": transport})))

    assert found == {
        "transport": "ok",
        "alternative 1": "ok",
        "alternative 2": "fail",
        "uplink 1": "fail",
        "console": "ok",
    }


# --- certificates --------------------------------------------------------------------------------------------------

MADE = datetime(2026, 8, 1, 12, tzinfo=UTC)
TLS = "tls/10.0.0.1:7447"


@pytest.fixture
def pki(tmp_path: Path) -> Path:
    init(tmp_path / "pki", ["10.0.0.1"], now=MADE)
    return tmp_path / "pki"


def certificates(folder: Path, endpoint: str = TLS, now: datetime = MADE) -> dict[str, Finding]:
    transport = Transport(endpoint=endpoint, credentials=str(folder))
    return {finding.subject: finding for finding in check_certificates(transport, now)}


@pytest.mark.parametrize("endpoint", ["", "tcp/127.0.0.1:7447"])
def test_certificates_are_not_asked_for_where_none_are_shown(endpoint: str, tmp_path: Path) -> None:
    assert levels(check_certificates(Transport(endpoint=endpoint), MADE)) == {"certificates": "ok"}
    assert [found.level for found in certificates(tmp_path / "none", endpoint).values()] == ["ok"]


@pytest.mark.parametrize(
    "transport", [Transport(endpoint=TLS), Transport(endpoint="tls/127.0.0.1:7447"), Transport(alternatives=(TLS,))]
)
def test_an_endpoint_that_wants_certificates_fails_without_them(transport: Transport) -> None:
    (finding,) = check_certificates(transport, MADE)

    assert finding.level == "fail"
    assert "covrecon pki init" in finding.advice


def test_each_certificate_of_this_computer_is_told_with_its_days(pki: Path) -> None:
    renew(pki, ["sim"], now=MADE, life=timedelta(days=13))
    found = certificates(pki)

    assert {subject: (finding.level, finding.text) for subject, finding in found.items()} == {
        "certificate ground": ("ok", "ground.1, 90 days left"),
        "certificate router": ("ok", "router.1, 90 days left"),
        "certificate sim": ("warn", "sim.2, 13 days left"),
        "register": ("ok", "certificates that the router admits: 4"),
    }
    assert found["certificate sim"].advice == "covrecon pki renew sim"


def test_an_expired_or_unsafe_certificate_fails_with_what_mends_it(pki: Path) -> None:
    (pki / "ground.key").chmod(0o644)
    found = certificates(pki)
    assert (found["certificate ground"].level, found["certificate ground"].advice) == (
        "fail",
        f"run: chmod 600 {pki}/ground.key",
    )
    assert found["certificate sim"].level == "ok"

    late = certificates(pki, now=MADE + timedelta(days=90))
    assert late["certificate router"].text.startswith(f"{pki}/router.pem: expired at 2026-10-30 12:00 UTC")
    assert "covrecon pki renew router" in late["certificate router"].advice


def test_a_router_needs_its_register_and_a_drone_does_not(pki: Path) -> None:
    (pki / "register.json").unlink()
    found = certificates(pki)
    assert (found["register"].level, found["certificate router"].level) == ("fail", "ok")

    (pki / "router.pem").unlink()
    assert set(certificates(pki)) == {"certificate ground", "certificate sim"}


def test_a_folder_without_certificates_fails(tmp_path: Path) -> None:
    assert certificates(tmp_path / "none")["certificates"].level == "fail"


@pytest.mark.parametrize(
    ("endpoint", "known"),
    [
        ("tls/10.0.0.1:7447", True),
        ("tls/[0:0::1]:7447", True),
        ("tls/LOCALHOST:7447", True),
        ("tls/0.0.0.0:7447", True),
        ("tls/10.0.0.9:7447", False),
        ("tls/ground.example:7447", False),
    ],
)
def test_a_router_must_go_by_the_name_by_which_it_is_called(pki: Path, endpoint: str, *, known: bool) -> None:
    found = certificates(pki, endpoint)

    assert ("router's names" not in found) is known
    if not known:
        host = endpoint.removeprefix("tls/").removesuffix(":7447")
        assert found["router's names"].level == "fail"
        assert found["router's names"].advice == f"covrecon pki renew router --host {host}"


def test_one_of_several_routers_goes_by_its_own_name(pki: Path) -> None:
    transport = Transport(endpoint="tls/10.0.0.9:7447", alternatives=(TLS,), credentials=str(pki))

    assert "router's names" not in {finding.subject for finding in check_certificates(transport, MADE)}


# --- files and devices ---------------------------------------------------------------------------------------------


def test_the_files_and_devices_of_a_mission_must_be_there(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").touch()
    drones = (
        PAIR[0].model_copy(update={"camera": str(tmp_path / "film.mp4"), "url": "serial:///dev/no-such-line:57600"}),
        PAIR[1].model_copy(update={"camera": "rtsp://10.0.0.4/stream"}),
    )
    scene = MISSION.simulation.model_copy(update={"scene": str(tmp_path / "room.glb")})
    mission = MISSION.model_copy(update={"drones": drones, "simulation": scene, "vehicles": Vehicles(kind="px4")})

    assert levels(check_inputs(mission)) == {"scene": "fail", "camera of drone 1": "ok", "PX4 of drone 1": "fail"}
    assert not list(check_inputs(MISSION))


# --- processor, memory, disk ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cores", "quota", "load_mean", "level"),
    [(8, float("inf"), 3.0, "ok"), (1, float("inf"), 0.0, "warn"), (8, 1.5, 0.0, "warn"), (8, 4.0, 5.0, "warn")],
)
def test_a_processor_that_is_small_or_busy_is_warned_of(cores: int, quota: float, load_mean: float, level: str) -> None:
    assert machine.check_processor(cores, quota, load_mean).level == level


@pytest.mark.parametrize(
    ("governor", "driver", "slow"),
    [
        ("powersave", "acpi-cpufreq", True),
        ("performance", "acpi-cpufreq", False),
        ("powersave", "intel_pstate", False),
        ("powersave", "amd-pstate-epp", False),
    ],
)
def test_a_governor_that_holds_the_frequency_low_is_warned_of(
    tmp_path: Path, governor: str, driver: str, *, slow: bool
) -> None:
    (tmp_path / "policy0").mkdir()
    (tmp_path / "policy0" / "scaling_governor").write_text(f"{governor}\n")
    (tmp_path / "policy0" / "scaling_driver").write_text(f"{driver}\n")

    assert bool(list(machine.check_governor(tmp_path))) is slow


def test_a_containers_limit_counts_as_the_memory_there_is(tmp_path: Path) -> None:
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal:       16000000 kB\nMemAvailable:    8000000 kB\n")
    assert machine.available_memory(meminfo, tmp_path) == 8_192_000_000
    (tmp_path / "memory.current").write_text("1000\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert machine.available_memory(meminfo, tmp_path) == 8_192_000_000
    (tmp_path / "memory.max").write_text("5000\n")
    assert machine.available_memory(meminfo, tmp_path) == 4000


def test_memory_and_disk_are_judged_by_what_the_mission_takes(tmp_path: Path) -> None:
    fine = MISSION.model_copy(update={"reconstruction": Reconstruction(voxel_m=0.0125)})
    longer = MISSION.model_copy(update={"duration_s": 2 * MISSION.duration_s})
    unrecorded = MISSION.model_copy(update={"recording": Recording(enabled=False)})

    assert machine.voxels(fine) == pytest.approx(8 * machine.voxels(MISSION))
    assert machine.memory_need(fine) > machine.memory_need(MISSION)
    assert machine.disk_need(longer) > 1.8 * machine.disk_need(MISSION)
    assert machine.disk_need(unrecorded) < 0.6 * machine.disk_need(MISSION)
    assert machine.check_memory(2e9, 1e9).level == "fail"
    assert machine.check_memory(2e9, 3e9).level == "ok"
    free = os.statvfs(tmp_path).f_bavail * os.statvfs(tmp_path).f_frsize
    runs = tmp_path / "not" / "there" / "yet"
    assert [machine.check_disk(free * share, runs).level for share in (0.01, 0.8, 2.0)] == ["ok", "warn", "fail"]
    assert not (tmp_path / "not").exists()


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()

    finding = machine.check_disk(1.0, tmp_path / "file" / "runs")
    assert (finding.level, finding.advice) == ("fail", "choose another folder: covrecon run --out")


def test_compiled_code_without_a_place_is_warned_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert machine.check_compiled().level == "ok"
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "cache"))
    assert machine.check_compiled().level == "warn"


# --- the command ---------------------------------------------------------------------------------------------------

APP = App(name="covrecon")
APP.command(doctor)


@pytest.fixture
def two_findings(monkeypatch: pytest.MonkeyPatch) -> list[Mission]:
    """Replaces the examination; the missions that it was asked about."""
    asked = []

    def examine(mission: Mission, _out: Path, _drone: int) -> Iterator[Finding]:
        asked.append(mission)
        yield Finding("clock", "warn", "not synchronised [maybe]", "run: timedatectl")
        if mission.name != "mission":
            yield Finding("disk", "fail", "full", "delete old runs")

    monkeypatch.setattr(examination, "examine", examine)
    return asked


def test_a_warning_alone_is_no_failure(two_findings: list[Mission], capsys: pytest.CaptureFixture[str]) -> None:
    assert APP(["doctor", "--drones", "3"], result_action="return_value") == 0

    assert capsys.readouterr().out.splitlines() == [
        "warn clock                not synchronised [maybe]",
        "                          -> run: timedatectl",
        "0 to mend, 1 to know of, 0 well",
    ]
    assert [drone.id for drone in two_findings[0].drones] == [1, 2, 3]


def test_a_failure_is_the_exit_code_and_machines_get_json(
    two_findings: list[Mission], root_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    demo = str(root_path / "missions" / "demo.toml")
    assert APP(["doctor", demo, "--json"], result_action="return_value") == 1

    assert two_findings[0].name == "demo"
    assert json.loads(capsys.readouterr().out) == [
        {"subject": "clock", "level": "warn", "text": "not synchronised [maybe]", "advice": "run: timedatectl"},
        {"subject": "disk", "level": "fail", "text": "full", "advice": "delete old runs"},
    ]


@pytest.mark.light
def test_this_computer_is_examined_from_end_to_end(tmp_path: Path) -> None:
    mission = MISSION.model_copy(update={"console": Console(port=0)})
    found = list(examination.examine(mission, tmp_path))

    subjects = {finding.subject for finding in found}
    assert {"python", "transport", "console", "certificates", "socket", "clock", "processor"} <= subjects
    assert {"compiled code", "memory", "disk", "gpu", "libraries", "libraries [ground]"} <= subjects
    assert not [finding for finding in found if finding.level == "fail"]
    assert all(finding.advice for finding in found if finding.level != "ok")
