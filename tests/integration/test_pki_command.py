"""The command as people type it, from a new authority to a stolen drone."""

from __future__ import annotations

import json
import ssl
import stat
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from deploy.pki.authority import issue, renew
from faults.certificates import make_foreign
from protocol.credentials import load_credentials, load_register
from protocol.guard import ROOT

pytestmark = pytest.mark.light

PROGRAM = "from deploy.cli import main; main()"


def pki(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-P", "-c", PROGRAM, "pki", *arguments],
        cwd=folder,
        env={"PYTHONPATH": str(ROOT), "PATH": "", "COLUMNS": "120"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def done(folder: Path, *arguments: str) -> list[str]:
    result = pki(folder, *arguments)
    assert (result.returncode, result.stderr) == (0, "")
    return result.stdout.splitlines()


@pytest.fixture(scope="module")
def office(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the authority's folder lies, with two drones and an operator; tests add to it."""
    folder = tmp_path_factory.mktemp("office")
    done(folder, "init", "--host", "10.0.0.1", "--host", "ground.example")
    done(folder, "issue", "drone-1..2", "operator-anna")
    return folder


def test_a_new_authority_says_what_to_copy_and_never_its_key(tmp_path: Path) -> None:
    said = done(tmp_path, "init", "my fleet", "--host", "10.0.0.1", "--days", "30")

    assert said[0].startswith("my fleet: a new authority; keep my fleet/ca.key secret")
    assert [line.partition(":")[0] for line in said[1:4]] == ["router.1", "ground.1", "sim.1"]
    assert said[1].endswith("UTC, 30 days")
    (copy,) = [line.split() for line in said if "scp" in line]
    assert copy[-1] == "GROUND:/etc/covrecon/pki/"
    assert "ca.key" not in " ".join(copy)
    assert said[-1] == "Next, for each drone and operator: covrecon pki issue drone-1 operator-anna --folder 'my fleet'"
    assert stat.S_IMODE((tmp_path / "my fleet" / "ca.key").stat().st_mode) == 0o600


def test_a_drone_gets_its_own_files_alone(office: Path) -> None:
    said = done(office, "issue", "drone-8")

    assert said[0].startswith("drone-8.1: valid until ")
    assert said[0].endswith(" UTC, 90 days")
    assert said[1:] == [
        "To copy, where it is another computer:",
        "  scp -p pki/ca.pem pki/drone-8.pem pki/drone-8.key DRONE-8:/etc/covrecon/pki/",
        "  scp -p pki/register.json GROUND:/etc/covrecon/pki/",
        "Then have the router read its register: ssh GROUND systemctl reload covrecon-router",
    ]


def test_a_range_of_drones_is_spelt_out(office: Path) -> None:
    admitted = load_register(office / "pki").admitted(datetime.now(UTC))

    assert {"drone-1.1", "drone-2.1", "operator-anna.1"} <= set(admitted)
    for names, what in (
        (["drone-8..5"], "drone-8..5: goes backwards; drone-5..8 is meant"),
        (["drone-250..256"], "'drone-256' cannot have a certificate"),
        ([], "say whose: drone-3"),
    ):
        result = pki(office, "issue", *names)
        assert result.returncode == 2
        assert result.stderr.startswith(what)


def test_what_cannot_be_done_is_said_on_stderr_with_exit_code_2(office: Path, tmp_path: Path) -> None:
    for folder, arguments, what in (
        (office, ["init", "--host", "10.0.0.1"], "pki/ca.key is there already"),
        (office, ["issue", "drone-1"], "drone-1.1 is valid until"),
        (office, ["renew"], "say whose, or --all, not both"),
        (office, ["renew", "drone-1", "--all"], "say whose, or --all, not both"),
        (office, ["renew", "drone-77"], "drone-77 has no certificate yet"),
        (office, ["revoke", "drone-77"], "never issued: drone-77; there are router, ground, sim, drone-1"),
        (office, ["revoke"], "say whose"),
        (tmp_path, ["show"], "pki: no such folder"),
        (tmp_path, ["issue", "drone-1", "--folder", "elsewhere"], "elsewhere: no such folder"),
    ):
        result = pki(folder, *arguments)
        assert (result.returncode, result.stdout) == (2, "")
        assert result.stderr.startswith(what)
        assert result.stderr.count("\n") == 1


def test_renewing_says_that_the_old_ones_stay_valid(office: Path) -> None:
    issue(office / "pki", ["drone-5"], now=datetime.now(UTC), life=timedelta(days=10))

    assert done(office, "renew", "--all", "--within", "5") == ["nothing to renew"]
    said = done(office, "renew", "--all", "--within", "30")
    assert said[0].startswith("drone-5.2: valid until ")
    assert said[-2:] == [
        "The old ones stay valid until they expire. Once the new ones are in place:",
        "  covrecon pki revoke drone-5.1",
    ]
    assert done(office, "revoke", "drone-5.1")[-1] == "Still valid: drone-5.2"


def test_a_stolen_drone_is_shut_out_and_replaced(office: Path) -> None:
    issue(office / "pki", ["drone-6"], now=datetime.now(UTC))
    said = done(office, "revoke", "drone-6")

    assert said[0].startswith("drone-6.1: revoked at ")
    assert said[1:] == [
        "The router admits them until it has the new register. Copy it now, and have it read:",
        "  scp -p pki/register.json GROUND:/etc/covrecon/pki/",
        "  ssh GROUND systemctl reload covrecon-router",
        "A new one for drone-6: covrecon pki issue drone-6",
    ]
    assert done(office, "issue", "drone-6")[0].startswith("drone-6.2: ")


def test_a_stolen_router_takes_a_new_authority(tmp_path: Path) -> None:
    done(tmp_path, "init", "--host", "10.0.0.1")

    said = "\n".join(done(tmp_path, "revoke", "router"))
    assert "Give it another before all else:\n  covrecon pki issue router --host ADDRESS\n" in said
    assert "can pose as the router until it\nexpires" in said
    assert "covrecon pki init NEW-FOLDER" in said


def test_what_is_there_is_shown_and_what_is_wrong_is_the_exit_code(tmp_path: Path) -> None:
    done(tmp_path, "init", "--host", "10.0.0.1")
    renew(tmp_path / "pki", ["sim"], now=datetime.now(UTC), life=timedelta(days=2, minutes=1))

    header, *rows = done(tmp_path, "show")
    assert header.split() == ["name", "issue", "valid", "until", "(UTC)", "days", "left", "state"]
    assert [row.split()[0] for row in rows] == ["ca", "router", "ground", "sim", "sim"]
    assert [row.split()[-1] for row in rows] == ["valid", "valid", "valid", "replaced", "soon"]
    (tmp_path / "pki" / "sim.key").chmod(0o640)
    result = pki(tmp_path, "show", "pki", "--json")
    shown = json.loads(result.stdout)
    assert result.returncode == 1
    assert shown["faults"] == ["pki/sim.key: others than its owner may read or change it; run: chmod 600 pki/sim.key"]
    (newest,) = [item for item in shown["certificates"] if (item["name"], item["issue"]) == ("sim", 2)]
    assert newest["state"] == "expires soon"
    assert newest["days_left"] == 2
    assert datetime.fromisoformat(newest["expires"]).tzinfo is not None
    result = pki(tmp_path, "show")
    assert (result.returncode, result.stdout.splitlines()[-1]) == (1, f"to mend: {shown['faults'][0]}")


# --- another implementation's opinion ------------------------------------------------------------------------------


def shake_hands(router: Path, drone: Path, host: str) -> str:
    """Mutual TLS between a router and a drone, by OpenSSL; the common name that the router sees."""
    server_side, client_side = (
        ssl.create_default_context(purpose, cafile=str(folder / "ca.pem"))
        for purpose, folder in ((ssl.Purpose.CLIENT_AUTH, router), (ssl.Purpose.SERVER_AUTH, drone))
    )
    for context in (server_side, client_side):
        context.verify_flags |= ssl.VERIFY_X509_STRICT
    server_side.verify_mode = ssl.CERT_REQUIRED
    server_side.load_cert_chain(router / "router.pem", router / "router.key")
    client_side.load_cert_chain(drone / "drone-1.pem", drone / "drone-1.key")
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    server = server_side.wrap_bio(to_server, to_client, server_side=True)
    client = client_side.wrap_bio(to_client, to_server, server_hostname=host)
    for _ in range(3):  # hello, certificates, done
        for end in (client, server):
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                continue
    shown = server.getpeercert()
    assert shown is not None
    return dict(field[0] for field in shown["subject"])["commonName"]  # type: ignore[misc]


@pytest.mark.parametrize("host", ["10.0.0.1", "ground.example", "localhost", "127.0.0.1", "::1"])
def test_openssl_takes_the_certificates_for_every_name_of_the_router(office: Path, host: str) -> None:
    folder = office / "pki"

    assert shake_hands(folder, folder, host) == load_credentials(folder, "drone-1", now=datetime.now(UTC)).common_name


def test_openssl_refuses_another_name_and_a_foreign_drone(office: Path, tmp_path: Path) -> None:
    foreign = make_foreign(tmp_path / "foreign", office / "pki")

    with pytest.raises(ssl.SSLCertVerificationError, match=r"not valid for '10\.0\.0\.2'"):
        shake_hands(office / "pki", office / "pki", "10.0.0.2")
    with pytest.raises(ssl.SSLError, match="certificate verify failed"):
        shake_hands(office / "pki", foreign.folder, "10.0.0.1")
