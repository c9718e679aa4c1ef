"""What the authority issues, renews and revokes, what it leaves on disk, and what it says of a folder."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import stat
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec

from deploy.pki.authority import init, issue, renew, revoke
from deploy.pki.inventory import Inventory, take_inventory
from deploy.pki.signing import hosts_of, make_authority, make_certificate
from faults.certificates import load_authority
from faults.disk import dies
from protocol.certificates import load_certificate
from protocol.credentials import Entry, identities_in, load_credentials, load_register
from protocol.errors import CredentialsError

NOW = datetime(2026, 8, 1, 12, tzinfo=UTC)
DAY = timedelta(days=1)
LIFE = 90 * DAY
GROUND_FILES = {"ca.pem", "ca.key", "register.json"} | {
    f"{identity}.{kind}" for identity in ("router", "ground", "sim") for kind in ("pem", "key")
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "pki"
    init(folder, ["10.0.0.1", "ground.example"], now=NOW)
    issue(folder, ["drone-1", "drone-2"], now=NOW)
    return folder


@pytest.fixture
def fleet(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "pki"))


def names(entries: tuple[Entry, ...]) -> list[str]:
    return [entry.common_name for entry in entries]


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def refusal(action: Callable[[], object]) -> str:
    with pytest.raises(CredentialsError) as caught:
        action()
    return str(caught.value)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


# --- init ----------------------------------------------------------------------------------------------------------


def test_a_new_authority_has_certificates_for_the_ground_stations_computer(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "pki"

    assert names(init(folder, ["10.0.0.1"], now=NOW)) == ["router.1", "ground.1", "sim.1"]
    assert {path.name for path in folder.iterdir()} == GROUND_FILES
    for identity in ("router", "ground", "sim"):
        assert load_credentials(folder, identity, now=NOW).expires == NOW + LIFE


def test_keys_are_for_their_owner_alone_whatever_the_umask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        init(tmp_path / "pki", ["10.0.0.1"], now=NOW)
    finally:
        os.umask(before)

    assert mode(tmp_path / "pki") == 0o700
    for path in (tmp_path / "pki").iterdir():
        assert mode(path) == (0o600 if path.suffix == ".key" else 0o644)


def test_the_authority_signs_certificates_that_sign_no_others(made: Path) -> None:
    authority = load_certificate(made / "ca.pem", "")
    constraints = authority.extensions.get_extension_for_class(x509.BasicConstraints)
    usage = authority.extensions.get_extension_for_class(x509.KeyUsage)

    assert (constraints.value.ca, constraints.value.path_length, constraints.critical) == (True, 0, True)
    assert usage.critical
    assert usage.value.key_cert_sign
    assert not usage.value.digital_signature
    assert isinstance(authority.public_key(), ec.EllipticCurvePublicKey)
    assert authority.not_valid_after_utc - NOW == 3653 * DAY
    drone = load_certificate(made / "drone-1.pem", "")
    assert not drone.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert not drone.extensions.get_extension_for_class(x509.KeyUsage).value.key_cert_sign


def test_only_the_router_can_be_a_server_and_it_goes_by_all_its_names(made: Path) -> None:
    hosts = {name: hosts_of(load_certificate(made / f"{name}.pem", "")) for name in identities_in(made)}

    assert hosts.pop("router") == ("10.0.0.1", "ground.example", "localhost", "127.0.0.1", "::1")
    assert set(hosts.values()) == {()}


def test_an_authority_is_never_overwritten(fleet: Path) -> None:
    before = content(fleet)

    message = refusal(lambda: init(fleet, ["10.0.0.1"], now=NOW))
    assert message.startswith(f"{fleet}/ca.key is there already, ")
    assert content(fleet) == before
    (fleet / "ca.key").unlink()  # as on the ground station's computer
    assert refusal(lambda: init(fleet, ["10.0.0.1"], now=NOW)).startswith(f"{fleet}/ca.pem is there already, ")


@pytest.mark.parametrize("host", ["", "tls/10.0.0.1:7447", "10.0.0.1:7447", "10.0.0.300", "*.example", "a b", "-a"])
def test_a_host_that_is_neither_an_address_nor_a_name_is_refused(tmp_path: Path, host: str) -> None:
    message = refusal(lambda: init(tmp_path / "pki", ["10.0.0.1", host], now=NOW))

    assert message.startswith(f"{host!r} is neither an address nor a name; ")
    assert not (tmp_path / "pki").exists()


def test_an_empty_folder_is_closed_to_others_and_a_used_one_must_be(tmp_path: Path) -> None:
    empty, used = tmp_path / "empty", tmp_path / "used"
    for folder in (empty, used):
        folder.mkdir()
        folder.chmod(0o755)
    (used / "letters.txt").touch()

    init(empty, ["10.0.0.1"], now=NOW)
    assert mode(empty) == 0o700
    message = refusal(lambda: init(used, ["10.0.0.1"], now=NOW))
    assert message == f"{used}: others than its owner may enter it; run: chmod 700 {used}"


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()

    assert refusal(lambda: init(tmp_path / "file" / "pki", ["::1"], now=NOW)) == f"{tmp_path}/file/pki: Not a directory"


# --- issue ---------------------------------------------------------------------------------------------------------


def test_a_certificate_lasts_as_long_as_it_is_asked_to_and_is_in_the_register(fleet: Path) -> None:
    (entry,) = issue(fleet, ["operator-anna"], now=NOW, life=30 * DAY)

    assert load_credentials(fleet, "operator-anna", now=NOW).expires == NOW + 30 * DAY
    assert load_register(fleet).certificates[-1] == entry
    assert int(entry.serial, 16) == load_certificate(fleet / "operator-anna.pem", "").serial_number
    assert (entry.issued, entry.expires, entry.revoked) == (NOW, NOW + 30 * DAY, None)


def test_no_certificate_outlives_its_authority() -> None:
    authority = make_authority(NOW)
    made = make_certificate(authority, "drone-1.1", now=NOW, life=4000 * DAY)

    assert made.certificate.not_valid_after_utc == authority.certificate.not_valid_after_utc


def test_who_has_a_valid_certificate_is_not_given_a_second(fleet: Path) -> None:
    before = content(fleet)

    message = refusal(lambda: issue(fleet, ["drone-3", "drone-2"], now=NOW + DAY))
    assert message == (
        "drone-2.1 is valid until 2026-10-30; to replace it: covrecon pki renew drone-2; if it was lost or stolen:"
        " covrecon pki revoke drone-2"
    )
    assert content(fleet) == before
    assert names(issue(fleet, ["drone-3", "drone-2"], now=NOW + LIFE)) == ["drone-3.1", "drone-2.2"]


def test_only_parties_of_a_fleet_are_issued_certificates(fleet: Path) -> None:
    for identity in ("drone-0", "drone-3.1", "ca", "../x", "operator-Anna"):
        message = refusal(lambda identity=identity: issue(fleet, [identity], now=NOW))  # type: ignore[misc]
        assert message.startswith(
            f"{identity!r} cannot have a certificate; there are router, ground, sim, mapper, mocap, drone-1 to"
        )


def test_a_name_given_twice_is_issued_once(fleet: Path) -> None:
    assert names(issue(fleet, ["drone-7", "drone-7"], now=NOW)) == ["drone-7.1"]


def test_a_process_that_makes_the_map_may_have_a_certificate(fleet: Path) -> None:
    assert names(issue(fleet, ["mapper"], now=NOW)) == ["mapper.1"]


def test_only_a_router_has_hosts_and_needs_some(fleet: Path) -> None:
    assert refusal(lambda: issue(fleet, ["drone-3"], now=NOW, hosts=["10.0.0.1"])).startswith(
        "only the router has hosts"
    )
    revoke(fleet, ["router"], now=NOW)
    assert refusal(lambda: issue(fleet, ["router"], now=NOW)) == (
        "say by which address or name the others call the router: --host"
    )
    assert names(issue(fleet, ["router"], now=NOW, hosts=["10.0.0.9"])) == ["router.2"]
    assert hosts_of(load_certificate(fleet / "router.pem", ""))[0] == "10.0.0.9"


@pytest.mark.parametrize("name", ["ca.key", "ca.pem", "register.json"])
def test_certificates_are_made_in_the_authoritys_folder_alone(fleet: Path, name: str) -> None:
    (fleet / name).unlink()

    assert refusal(lambda: issue(fleet, ["drone-3"], now=NOW)).startswith(f"{fleet}/{name}: no such file; ")


def test_a_folder_that_is_not_there_is_told_with_what_makes_it(tmp_path: Path) -> None:
    message = refusal(lambda: issue(tmp_path / "pki", ["drone-3"], now=NOW))

    assert message.startswith(f"{tmp_path}/pki: no such folder; ")
    assert "covrecon pki init" in message


def test_a_key_of_another_authority_signs_nothing(fleet: Path) -> None:
    (fleet / "ca.key").write_bytes(make_authority(NOW).key_pem())

    assert refusal(lambda: issue(fleet, ["drone-3"], now=NOW)).startswith(f"{fleet}/ca.key: not the key of ca.pem; ")


def test_an_authority_that_has_expired_or_is_from_the_future_signs_nothing(fleet: Path) -> None:
    assert "expired at 2036-08-01" in refusal(lambda: issue(fleet, ["drone-3"], now=NOW + 3653 * DAY))
    assert "may be wrong" in refusal(lambda: issue(fleet, ["drone-3"], now=NOW - DAY))


# --- renew ---------------------------------------------------------------------------------------------------------


def test_a_renewed_certificate_has_a_new_number_and_a_new_key_and_the_old_one_stays_admitted(fleet: Path) -> None:
    old = (fleet / "drone-1.key").read_bytes()

    assert names(renew(fleet, ["drone-1"], now=NOW + DAY)) == ["drone-1.2"]
    assert load_credentials(fleet, "drone-1", now=NOW + DAY).common_name == "drone-1.2"
    assert (fleet / "drone-1.key").read_bytes() != old
    assert {"drone-1.1", "drone-1.2"} <= set(load_register(fleet).admitted(NOW + DAY))


def test_a_router_keeps_its_hosts_unless_it_is_given_others(fleet: Path) -> None:
    before = hosts_of(load_certificate(fleet / "router.pem", ""))

    renew(fleet, ["router", "ground"], now=NOW)
    assert hosts_of(load_certificate(fleet / "router.pem", "")) == before
    renew(fleet, ["router"], now=NOW, hosts=["10.0.0.7", "127.0.0.1"])
    assert hosts_of(load_certificate(fleet / "router.pem", "")) == ("10.0.0.7", "127.0.0.1", "localhost", "::1")
    assert hosts_of(load_certificate(fleet / "ground.pem", "")) == ()


def test_all_that_end_soon_are_renewed_and_what_is_revoked_is_not(fleet: Path) -> None:
    issue(fleet, ["drone-3"], now=NOW, life=10 * DAY)
    issue(fleet, ["drone-4"], now=NOW, life=11 * DAY)
    revoke(fleet, ["drone-2"], now=NOW)

    assert names(renew(fleet, now=NOW, within=10 * DAY)) == ["drone-3.2"]
    assert names(renew(fleet, now=NOW, within=10 * DAY)) == []
    assert names(renew(fleet, ["drone-4", "drone-1"], now=NOW, within=11 * DAY)) == ["drone-4.2"]
    everybody = ["router.2", "ground.2", "sim.2", "drone-1.2", "drone-3.3", "drone-4.3"]
    assert names(renew(fleet, now=NOW)) == everybody


def test_an_expired_certificate_can_be_renewed(fleet: Path) -> None:
    assert names(renew(fleet, ["drone-1"], now=NOW + 2 * LIFE)) == ["drone-1.2"]


def test_what_was_revoked_or_never_issued_is_not_renewed(fleet: Path) -> None:
    revoke(fleet, ["drone-1"], now=NOW)

    assert refusal(lambda: renew(fleet, ["drone-1"], now=NOW)) == (
        "drone-1 is revoked; for a new one: covrecon pki issue drone-1"
    )
    assert refusal(lambda: renew(fleet, ["drone-2", "drone-5"], now=NOW)) == (
        "drone-5 has no certificate yet; for a new one: covrecon pki issue drone-5"
    )
    assert len(load_register(fleet).of("drone-2")) == 1


# --- revoke --------------------------------------------------------------------------------------------------------


def test_a_stolen_drone_loses_all_its_certificates_and_a_new_one_has_the_next_number(fleet: Path) -> None:
    renew(fleet, ["drone-1"], now=NOW)

    assert names(revoke(fleet, ["drone-1"], now=NOW + DAY)) == ["drone-1.1", "drone-1.2"]
    register = load_register(fleet)
    assert "drone-2.1" in register.admitted(NOW + DAY)
    assert [entry.revoked for entry in register.of("drone-1")] == [NOW + DAY, NOW + DAY]
    assert names(issue(fleet, ["drone-1"], now=NOW + DAY)) == ["drone-1.3"]
    assert set(load_register(fleet).admitted(NOW + DAY)) & {"drone-1.1", "drone-1.2", "drone-1.3"} == {"drone-1.3"}


def test_a_single_certificate_can_be_revoked(fleet: Path) -> None:
    renew(fleet, ["drone-1"], now=NOW)

    assert names(revoke(fleet, ["drone-1.1"], now=NOW)) == ["drone-1.1"]
    assert load_credentials(fleet, "drone-1", now=NOW).common_name == "drone-1.2"


def test_files_of_a_revoked_certificate_are_deleted(fleet: Path) -> None:
    revoke(fleet, ["drone-1"], now=NOW)

    assert not [path for path in fleet.iterdir() if path.name.startswith("drone-1.")]
    assert load_credentials(fleet, "drone-2", now=NOW)


def test_what_is_revoked_stays_revoked_since_then(fleet: Path) -> None:
    revoke(fleet, ["drone-1"], now=NOW)
    (again,) = revoke(fleet, ["drone-1"], now=NOW + DAY)

    assert again.revoked == NOW


def test_what_was_never_issued_cannot_be_revoked(fleet: Path) -> None:
    before = content(fleet)

    message = refusal(lambda: revoke(fleet, ["drone-1", "drone-9", "drone-1.4"], now=NOW))
    assert message == "never issued: drone-1.4, drone-9; there are router, ground, sim, drone-1, drone-2"
    assert content(fleet) == before


def test_it_is_possible_to_revoke_without_the_authoritys_key(fleet: Path) -> None:
    (fleet / "ca.key").unlink()

    assert names(revoke(fleet, ["drone-1"], now=NOW)) == ["drone-1.1"]


# --- crashes and rivals --------------------------------------------------------------------------------------------


def test_a_run_that_dies_leaves_no_certificate_that_the_register_lacks(made: Path, tmp_path: Path) -> None:
    step, died = 0, True
    while died:
        fleet = Path(shutil.copytree(made, tmp_path / str(step)))
        died = dies(lambda fleet=fleet: renew(fleet, ["drone-1", "router"], now=NOW), step)  # type: ignore[misc]

        register = load_register(fleet)
        serials = {int(entry.serial, 16) for entry in register.certificates}
        for identity in identities_in(fleet):
            assert load_certificate(fleet / f"{identity}.pem", "").serial_number in serials
        for path in fleet.iterdir():
            assert "key" not in path.name or mode(path) == 0o600
        renew(fleet, ["drone-1", "router"], now=NOW)  # and whatever was left of it is mended
        assert take_inventory(fleet, NOW).is_sound
        assert not [path for path in fleet.iterdir() if path.name.endswith(".draft")]
        step += 1
    assert step > 15


def test_a_full_disk_leaves_the_register_as_it_was(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = content(fleet)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert refusal(lambda: issue(fleet, ["drone-3"], now=NOW)) == "the disk: No space left on device"
    assert content(fleet) == before


def _issue_one(folder: Path, identity: str) -> None:
    issue(folder, [identity], now=NOW)


@pytest.mark.light
def test_runs_at_the_same_time_do_not_forget_each_others_certificates(fleet: Path) -> None:
    context = multiprocessing.get_context("fork")
    identities = [f"drone-{number}" for number in range(11, 17)]
    runs = [context.Process(target=_issue_one, args=(fleet, identity)) for identity in identities]
    for run in runs:
        run.start()
    for run in runs:
        run.join(60)

    assert [run.exitcode for run in runs] == [0] * len(runs)
    assert {f"{identity}.1" for identity in identities} <= set(load_register(fleet).admitted(NOW))


# --- what there is -------------------------------------------------------------------------------------------------


def states(found: Inventory) -> dict[str, str]:
    return {f"{item.name}.{item.issue}": item.state for item in found.items}


def test_all_that_was_issued_is_listed_with_how_it_fares(fleet: Path) -> None:
    issue(fleet, ["drone-10", "operator-anna"], now=NOW, life=10 * DAY)
    issue(fleet, ["drone-3"], now=NOW, life=DAY)
    renew(fleet, ["drone-1"], now=NOW)
    revoke(fleet, ["drone-2"], now=NOW)
    found = take_inventory(fleet, NOW + DAY)

    assert states(found) == {
        "ca.0": "valid",
        "router.1": "valid",
        "ground.1": "valid",
        "sim.1": "valid",
        "drone-1.1": "replaced",
        "drone-1.2": "valid",
        "drone-2.1": "revoked",
        "drone-3.1": "expired",
        "drone-10.1": "expires soon",
        "operator-anna.1": "expires soon",
    }
    assert list(states(found))[-4:] == ["drone-2.1", "drone-3.1", "drone-10.1", "operator-anna.1"]
    assert {item.name: item.days_left for item in found.items}["drone-10"] == 9
    assert not found.is_sound
    revoke(fleet, ["drone-3"], now=NOW)
    assert take_inventory(fleet, NOW + DAY).is_sound


def test_a_certificate_whose_successor_was_revoked_is_in_use_again(fleet: Path) -> None:
    renew(fleet, ["drone-1"], now=NOW)
    revoke(fleet, ["drone-1.2"], now=NOW)

    found = states(take_inventory(fleet, NOW + LIFE))
    assert (found["drone-1.1"], found["drone-1.2"]) == ("expired", "revoked")


def test_a_drones_folder_is_listed_without_a_register(made: Path, tmp_path: Path) -> None:
    drone = tmp_path / "drone"
    drone.mkdir(mode=0o700)
    for name in ("ca.pem", "drone-1.pem", "drone-1.key"):
        shutil.copy2(made / name, drone / name)

    assert states(take_inventory(drone, NOW)) == {"ca.0": "valid", "drone-1.1": "valid"}
    assert take_inventory(drone, NOW).is_sound
    expired = take_inventory(drone, NOW + LIFE)
    assert states(expired) == {"ca.0": "valid", "drone-1.1": "expired"}
    assert "covrecon pki renew drone-1" in expired.faults[0]


def test_what_is_unsafe_is_told_with_what_mends_it(fleet: Path) -> None:
    for name in ("ca.key", "drone-1.key"):
        (fleet / name).chmod(0o644)
    fleet.chmod(0o755)
    found = take_inventory(fleet, NOW)

    assert [fault.partition("; run: ")[2] for fault in found.faults] == [
        f"chmod 600 {fleet}/drone-1.key",
        f"chmod 700 {fleet}",
        f"chmod 600 {fleet}/ca.key",
    ]
    assert not found.is_sound


def test_what_is_damaged_is_told_and_the_rest_listed(fleet: Path) -> None:
    (fleet / "register.json").write_text("{")
    (fleet / "drone-1.pem").write_text("")
    shutil.copy2(fleet / "sim.pem", fleet / "drone-2.pem")
    found = take_inventory(fleet, NOW)

    assert any("register.json: damaged" in fault for fault in found.faults)
    assert any("drone-1.pem: not a certificate" in fault for fault in found.faults)
    assert any("drone-2.key: not the key of drone-2.pem" in fault for fault in found.faults)
    assert {"router.1", "ground.1", "sim.1"} <= set(states(found))
    assert not found.is_sound


def test_a_folder_without_an_authority_is_none_of_ours(tmp_path: Path) -> None:
    assert "covrecon pki init" in refusal(lambda: take_inventory(tmp_path, NOW))
    assert "no such folder" in refusal(lambda: take_inventory(tmp_path / "none", NOW))


def test_the_authoritys_own_end_is_told(fleet: Path) -> None:
    assert states(take_inventory(fleet, NOW + 3645 * DAY))["ca.0"] == "expires soon"
    assert states(take_inventory(fleet, NOW + 3653 * DAY))["ca.0"] == "expired"


def test_the_authoritys_key_is_of_the_authority(made: Path) -> None:
    authority = load_authority(made)

    assert authority.key.public_key() == authority.certificate.public_key()
