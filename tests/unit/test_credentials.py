"""Which certificates a process may show, which it must not, and what it says then."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import BestAvailableEncryption, Encoding, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID

from deploy.pki.authority import init, issue, revoke
from deploy.pki.signing import Pair, make_authority, make_certificate
from faults.certificates import (
    load_authority,
    make_credentials,
    make_expired,
    make_foreign,
    make_misnamed,
    make_revoked,
)
from protocol.certificates import load_certificate, load_key
from protocol.credentials import (
    EXPIRY_WARNING,
    Credentials,
    Entry,
    Register,
    find_operator,
    identities_in,
    identity_of_drone,
    identity_of_name,
    load_credentials,
    load_register,
    split_common_name,
)
from protocol.errors import CredentialsError

NOW = datetime(2026, 8, 1, 12, tzinfo=UTC)
LIFE = timedelta(days=90)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "pki"
    init(folder, ["10.0.0.1"], now=NOW, life=LIFE)
    issue(folder, ["drone-1", "drone-3", "operator-anna"], now=NOW, life=LIFE)
    return folder


@pytest.fixture
def fleet(made: Path, tmp_path: Path) -> Path:
    """The authority's folder, to be spoilt."""
    return Path(shutil.copytree(made, tmp_path / "pki"))


@pytest.fixture
def drone(made: Path, tmp_path: Path) -> Path:
    """The folder of drone 3's computer."""
    folder = tmp_path / "drone"
    folder.mkdir(mode=0o700)
    for name in ("ca.pem", "drone-3.pem", "drone-3.key"):
        shutil.copy2(made / name, folder / name)
    return folder


def refusal(folder: Path, identity: str = "drone-3", now: datetime = NOW) -> str:
    with pytest.raises(CredentialsError) as caught:
        load_credentials(folder, identity, now=now)
    return str(caught.value)


def put(folder: Path, identity: str, pair: Pair) -> None:
    (folder / f"{identity}.pem").write_bytes(pair.certificate_pem())
    (folder / f"{identity}.key").write_bytes(pair.key_pem())


# --- good ones -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("identity", ["router", "ground", "sim", "drone-1", "drone-3", "operator-anna"])
def test_what_the_authority_made_may_be_shown(made: Path, identity: str) -> None:
    credentials = load_credentials(made, identity, now=NOW)

    assert credentials == Credentials(made, identity, f"{identity}.1", NOW + LIFE)
    assert credentials.authority == made / "ca.pem"
    assert credentials.certificate == made / f"{identity}.pem"
    assert credentials.key == made / f"{identity}.key"


def test_a_drone_needs_no_register(drone: Path) -> None:
    assert load_credentials(drone, "drone-3", now=NOW).common_name == "drone-3.1"


@pytest.mark.parametrize(("before_end", "warned"), [(EXPIRY_WARNING, False), (EXPIRY_WARNING - timedelta(1), True)])
def test_a_certificate_that_ends_soon_is_warned_of(drone: Path, before_end: timedelta, *, warned: bool) -> None:
    warning = load_credentials(drone, "drone-3", now=NOW + LIFE - before_end).warning

    expected = "certificate drone-3.1 expires in 13 days, at 2026-10-30 12:00 UTC: covrecon pki renew drone-3"
    assert warning == (expected if warned else "")


@pytest.mark.parametrize(
    "moment", [NOW - timedelta(hours=1), NOW + LIFE - timedelta(seconds=1)], ids=["clock behind", "last second"]
)
def test_a_certificate_is_good_from_an_hour_before_it_was_made_to_its_last_second(
    drone: Path, moment: datetime
) -> None:
    assert load_credentials(drone, "drone-3", now=moment)


# --- bad ones ------------------------------------------------------------------------------------------------------


def test_a_folder_that_is_not_there_is_told_with_what_makes_it(tmp_path: Path) -> None:
    assert refusal(tmp_path / "none") == (
        f"{tmp_path}/none: no such folder; it holds the certificates that the authority's computer makes:"
        " covrecon pki issue drone-3"
    )


@pytest.mark.parametrize("name", ["ca.pem", "drone-3.pem", "drone-3.key"])
def test_a_file_that_is_missing_is_told_with_what_makes_it(drone: Path, name: str) -> None:
    (drone / name).unlink()

    message = refusal(drone)
    assert message.startswith(f"{drone}/{name}: no such file; ")
    assert ("the authority's computer" if name == "ca.pem" else "(covrecon pki issue drone-3)") in message


def test_a_file_that_cannot_be_read_is_told(drone: Path) -> None:
    (drone / "drone-3.key").unlink()
    (drone / "drone-3.key").mkdir()

    assert (
        refusal(drone)
        == f"{drone}/drone-3.key: cannot be read: Is a directory; whose is it? See: ls -l {drone}/drone-3.key"
    )


@pytest.mark.parametrize(
    ("name", "what"),
    [("ca.pem", "a certificate"), ("drone-3.pem", "a certificate"), ("drone-3.key", "a private key")],
)
@pytest.mark.parametrize("content", [b"", b"\x30\x82\x01\x00", b"-----BEGIN CERTIFICATE-----\nAAAA\n"])
def test_a_file_that_is_no_pem_is_refused(drone: Path, name: str, what: str, content: bytes) -> None:
    (drone / name).write_bytes(content)

    assert refusal(drone).startswith(f"{drone}/{name}: not {what} in PEM format; ")


def test_a_key_with_a_passphrase_is_refused(drone: Path) -> None:
    pair = make_certificate(make_authority(NOW), "drone-3.1", now=NOW, life=LIFE)
    (drone / "drone-3.key").write_bytes(
        pair.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"secret"))
    )

    assert refusal(drone).startswith(f"{drone}/drone-3.key: has a passphrase, which no process could type; ")


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o620, 0o601])
def test_a_key_that_others_may_touch_is_refused(drone: Path, mode: int) -> None:
    (drone / "drone-3.key").chmod(mode)

    assert refusal(drone) == (
        f"{drone}/drone-3.key: others than its owner may read or change it; run: chmod 600 {drone}/drone-3.key"
    )


def test_a_key_of_another_certificate_is_refused(made: Path, drone: Path) -> None:
    shutil.copy2(made / "drone-1.key", drone / "drone-3.key")

    assert refusal(drone) == (
        f"{drone}/drone-3.key: not the key of drone-3.pem; copy both again, or make a new one on the authority's"
        " computer (covrecon pki renew drone-3) and copy it here"
    )


@pytest.mark.parametrize("elder", [timedelta(0), timedelta(days=3)], ids=["same name", "another name"])
def test_a_certificate_of_a_foreign_authority_is_refused(drone: Path, elder: timedelta) -> None:
    foreign = make_authority(NOW - elder)
    put(drone, "drone-3", make_certificate(foreign, "drone-3.1", now=NOW, life=LIFE))

    assert refusal(drone).startswith(f"{drone}/drone-3.pem: not signed by the authority in the same folder; ")


def test_a_certificate_that_a_drone_signed_is_refused(made: Path, drone: Path) -> None:
    key = load_key(made / "drone-1.key", "")
    assert isinstance(key, EllipticCurvePrivateKey)
    stolen = Pair(load_certificate(made / "drone-1.pem", ""), key)
    put(drone, "drone-3", make_certificate(stolen, "drone-3.1", now=NOW, life=LIFE))
    shutil.copy2(made / "drone-1.pem", drone / "ca.pem")

    assert refusal(drone).startswith(f"{drone}/drone-3.pem: signed by a certificate that is no authority's; ")


@pytest.mark.parametrize(
    "common_name",
    ["drone-1.1", "drone-3", "drone-3.", "drone-3.0", "drone-3.1.1", "drone-33.1", "ground.1", "drone-3.1x"],
)
def test_a_certificate_of_somebody_else_is_refused(made: Path, drone: Path, common_name: str) -> None:
    put(drone, "drone-3", make_certificate(load_authority(made), common_name, now=NOW, life=LIFE))

    assert refusal(drone).startswith(f"{drone}/drone-3.pem: is the certificate of '{common_name}', not of drone-3; ")


def test_a_router_needs_a_certificate_for_servers(made: Path, fleet: Path) -> None:
    put(fleet, "router", make_certificate(load_authority(made), "router.1", now=NOW, life=LIFE))

    assert refusal(fleet, "router").startswith(f"{fleet}/router.pem: not for servers (extended key usage); ")


@pytest.mark.parametrize("uses", [[ExtendedKeyUsageOID.SERVER_AUTH], [ExtendedKeyUsageOID.EMAIL_PROTECTION], []])
def test_everybody_needs_a_certificate_for_clients(made: Path, drone: Path, uses: list[x509.ObjectIdentifier]) -> None:
    authority = load_authority(made)
    own = make_certificate(authority, "drone-3.1", now=NOW, life=LIFE)
    builder = (
        x509.CertificateBuilder()
        .subject_name(own.certificate.subject)
        .issuer_name(own.certificate.issuer)
        .public_key(own.key.public_key())
        .serial_number(1)
        .not_valid_before(NOW)
        .not_valid_after(NOW + LIFE)
    )
    if uses:
        builder = builder.add_extension(x509.ExtendedKeyUsage(uses), critical=False)
    put(drone, "drone-3", Pair(builder.sign(authority.key, SHA256()), own.key))

    assert refusal(drone).startswith(f"{drone}/drone-3.pem: not for clients (extended key usage); ")


def test_a_certificate_from_the_future_points_to_the_clock(drone: Path) -> None:
    message = refusal(drone, now=datetime(1970, 1, 1, 0, 5, tzinfo=UTC))

    assert message.startswith(
        f"{drone}/ca.pem: not valid before 2026-08-01 11:00 UTC, and the clock says 1970-01-01 00:05 UTC"
    )
    assert "the clock of this computer may be wrong" in message


def test_an_expired_certificate_is_told_with_what_renews_it(drone: Path) -> None:
    assert refusal(drone, now=NOW + LIFE) == (
        f"{drone}/drone-3.pem: expired at 2026-10-30 12:00 UTC, and the clock says 2026-10-30 12:00 UTC; make a new one"
        " on the authority's computer (covrecon pki renew drone-3) and copy it here"
    )


def test_an_expired_authority_is_told(drone: Path) -> None:
    assert refusal(drone, now=NOW + timedelta(days=3653)).startswith(f"{drone}/ca.pem: expired at 2036-08-01 12:00 UTC")


def test_where_the_register_is_known_a_revoked_certificate_is_refused(made: Path, fleet: Path) -> None:
    revoke(fleet, ["drone-3"], now=NOW + timedelta(minutes=2))
    for name in ("drone-3.pem", "drone-3.key"):
        shutil.copy2(made / name, fleet / name)

    assert refusal(fleet) == (
        f"{fleet}/drone-3.pem: drone-3.1 was revoked at 2026-08-01 12:02 UTC; make another on the authority's computer"
        " (covrecon pki issue drone-3) and copy it here"
    )


def test_where_the_register_is_older_than_the_certificate_it_is_to_be_copied_too(made: Path, fleet: Path) -> None:
    put(fleet, "drone-3", make_certificate(load_authority(made), "drone-3.2", now=NOW, life=LIFE))

    assert "drone-3.2 is not in register.json beside it, so the router refuses it" in refusal(fleet)


@pytest.mark.parametrize(
    "identity", ["drone-0", "drone-256", "drone-03", "../drone-3", "operator-", "ca", "", "drone-3\n"]
)
def test_only_parties_of_a_fleet_have_certificates(drone: Path, identity: str) -> None:
    assert refusal(drone, identity).startswith(
        f"{identity!r} cannot have a certificate; there are router, ground, sim, "
    )


# --- names ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("common_name", "identity", "number"),
    [
        ("drone-3.2", "drone-3", 2),
        ("drone-255.10", "drone-255", 10),
        ("router.1", "router", 1),
        ("operator-anna-2.12", "operator-anna-2", 12),
    ],
)
def test_a_common_name_is_identity_and_issue(common_name: str, identity: str, number: int) -> None:
    assert split_common_name(common_name) == (identity, number)
    assert identity_of_name(common_name) == identity


NO_COMMON_NAMES = [
    "drone-3",
    "drone-3.",
    ".1",
    "drone-3.0",
    "drone-3.01",
    "drone-3.-1",
    "drone-3.1.2",
    "drone-3.1x",
    "drone-3.²",
    "drone-03.1",
    "drone-256.1",
    "drone-*.1",
    "**.1",
    "operator-.1",
    "operator-a/b.1",
    "operator-Anna.1",
    "Router.1",
    "ca.1",
]


@pytest.mark.parametrize("common_name", ["", "drone-3.1 ", "drone-3.1\n", *NO_COMMON_NAMES])
def test_what_only_resembles_a_common_name_is_refused(common_name: str) -> None:
    with pytest.raises(CredentialsError, match="is not the name of a certificate"):
        split_common_name(common_name)


def test_the_identities_of_a_folder_are_those_of_its_certificates(made: Path, drone: Path) -> None:
    assert identities_in(made) == ["drone-1", "drone-3", "ground", "operator-anna", "router", "sim"]
    assert identities_in(drone) == [identity_of_drone(3)]
    assert identities_in(drone / "none") == []


def test_the_only_operator_of_a_folder_need_not_be_named(fleet: Path) -> None:
    assert find_operator(fleet) == "operator-anna"
    assert find_operator(fleet, "anna") == find_operator(fleet, "operator-anna") == "operator-anna"


def test_of_several_operators_one_must_be_named(fleet: Path) -> None:
    issue(fleet, ["operator-bert"], now=NOW)

    with pytest.raises(CredentialsError) as caught:
        find_operator(fleet)
    assert str(caught.value) == f"say which operator you are: {fleet} has operator-anna, operator-bert"
    assert find_operator(fleet, "bert") == "operator-bert"


def test_an_operator_without_a_certificate_is_told_what_there_is(fleet: Path, drone: Path) -> None:
    remedy = "make one on the authority's computer: covrecon pki issue"
    with pytest.raises(CredentialsError) as caught:
        find_operator(fleet, "cleo")
    assert str(caught.value) == (f"no certificate of operator-cleo: {fleet} has operator-anna; {remedy} operator-cleo")
    with pytest.raises(CredentialsError) as caught:
        find_operator(drone)
    assert str(caught.value) == f"{drone} has no operator's certificate; {remedy} operator-anna"


# --- the register --------------------------------------------------------------------------------------------------


def entry(common_name: str, *, days: int = 90, revoked: bool = False) -> Entry:
    expires = NOW + timedelta(days=days)
    return Entry(common_name=common_name, serial="AB", issued=NOW, expires=expires, revoked=NOW if revoked else None)


def test_the_register_admits_what_is_neither_revoked_nor_expired() -> None:
    entries = (
        entry("drone-1.1", revoked=True),
        entry("drone-1.2"),
        entry("drone-2.1", days=0),
        entry("ground.1", days=1),
    )
    register = Register(certificates=entries)

    assert register.admitted(NOW) == ("drone-1.2", "ground.1")
    assert register.admitted(NOW + timedelta(days=1)) == ("drone-1.2",)


def test_the_issues_of_an_identity_come_in_their_order() -> None:
    register = Register(certificates=(entry("drone-1.10"), entry("drone-1.9"), entry("drone-11.1")))

    assert [found.common_name for found in register.of("drone-1")] == ["drone-1.9", "drone-1.10"]
    assert register.of("drone-2") == ()


def test_a_register_that_is_missing_is_told(drone: Path) -> None:
    with pytest.raises(CredentialsError) as caught:
        load_register(drone)
    assert str(caught.value) == (
        f"{drone}/register.json: no such file; copy it again from the authority's computer;"
        " the router needs it to know whom to admit"
    )


def spoil(change: Callable[[dict[str, object]], object]) -> Callable[[str], str]:
    def spoilt(text: str) -> str:
        register = json.loads(text)
        change(register["certificates"][0])
        return json.dumps(register)

    return spoilt


@pytest.mark.parametrize(
    ("damage", "what"),
    [
        (lambda text: text[:100], "Invalid JSON"),
        (lambda _: "[]", ""),
        (lambda text: text.replace('"version": 1', '"version": 2'), "version: Input should be 1"),
        (spoil(lambda first: first.update(common_name="drone-*.1")), "certificates.0.common_name: "),
        (spoil(lambda first: first.update(common_name="ground.1")), "ground.1 is listed twice"),
        (spoil(lambda first: first.update(expires="2026-08-01T12:00:00")), "certificates.0.expires: "),
        (spoil(lambda first: first.update(revoked="no")), "certificates.0.revoked: "),
        (spoil(lambda first: first.pop("serial")), "certificates.0.serial: Field required"),
        (spoil(lambda first: first.update(valid=True)), "certificates.0.valid: "),
    ],
)
def test_a_damaged_register_admits_nobody(fleet: Path, damage: Callable[[str], str], what: str) -> None:
    path = fleet / "register.json"
    path.write_text(damage(path.read_text()))

    with pytest.raises(CredentialsError) as caught:
        load_register(fleet)
    message = str(caught.value)
    assert message.startswith(f"{path}: damaged: ")
    assert what in message
    assert message.endswith("; copy it again from the authority's computer")


# --- what tests of the transport are given -------------------------------------------------------------------------


def test_bad_certificates_are_bad_in_the_way_they_say(tmp_path: Path) -> None:
    fleet, now = tmp_path / "fleet", datetime.now(UTC)
    make_credentials(fleet)

    assert load_register(fleet).admitted(now) == tuple(
        f"{identity}.1" for identity in ("router", "ground", "sim", "drone-1", "drone-2", "operator-anna")
    )
    for make, what in ((make_expired, "expired"), (make_foreign, "not signed"), (make_misnamed, "'somebody-1.1'")):
        bad = make(tmp_path / make.__name__, fleet)
        assert what in refusal(bad.folder, bad.identity, now)
        assert bad.authority.read_bytes() == (fleet / "ca.pem").read_bytes()
    bad = make_revoked(tmp_path / "revoked", fleet)
    assert load_credentials(bad.folder, "drone-1", now=now) == bad
    assert "drone-1.1" not in load_register(fleet).admitted(now)
