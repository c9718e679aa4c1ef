"""zenoh's own router with the configuration that `covrecon mission router-config` prints."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
import zenoh

from deploy.local import environment
from faults.certificates import make_credentials
from faults.ports import free_port
from protocol.credentials import load_credentials
from protocol.session import Link, configuration

pytestmark = pytest.mark.light

PATIENCE_S = 20.0
POLL_S = 0.05
MISSION = """
name = "m"
[transport]
endpoint = "tls/127.0.0.1:{port}"
uplinks = ["tls/127.0.0.1:{above}"]
credentials = "pki"
[[drones]]
id = 1
start = [0.0, 0.0, 2.0, 0.0, 1.5]
"""
ROUTER = "import sys, zenoh; session = zenoh.open(zenoh.Config.from_file(sys.argv[1])); sys.stdin.read()"
"""What ``zenohd -c FILE`` does, by the same library."""
COVRECON = Path(sys.executable).with_name("covrecon")


@pytest.fixture
def link(tmp_path: Path) -> Iterator[Link]:
    """To a router that knows nothing of this program but its configuration file."""
    port = free_port()
    make_credentials(tmp_path / "pki", drones=(1, 2))
    mission = tmp_path / "m.toml"
    mission.write_text(MISSION.format(port=port, above=free_port()))
    printed = subprocess.run([COVRECON, "mission", "router-config", mission], capture_output=True, check=True)
    file = tmp_path / "router.json5"
    file.write_bytes(printed.stdout)
    router = subprocess.Popen([sys.executable, "-c", ROUTER, file], stdin=subprocess.PIPE, env=environment(os.environ))
    yield Link(f"tls/127.0.0.1:{port}")
    router.kill()
    router.communicate()


def session_of(link: Link, folder: Path, identity: str) -> zenoh.Session:
    credentials = load_credentials(folder / "pki", identity, now=datetime.now(UTC))
    told = configuration("client", Link(link.endpoint, credentials=credentials), "m")
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return zenoh.open(zenoh.Config.from_json5(json.dumps(told)))
        except zenoh.ZError:
            assert time.monotonic() < deadline


def test_it_lets_each_do_its_own_part_and_no_more(link: Link, tmp_path: Path) -> None:
    heard: list[str] = []
    with session_of(link, tmp_path, "ground") as ground, session_of(link, tmp_path, "drone-1") as drone:
        kept = ground.declare_subscriber("drone/*/state", lambda sample: heard.append(str(sample.key_expr)))
        with session_of(link, tmp_path, "drone-2") as absent:  # it has a certificate, but no place in the mission
            deadline = time.monotonic() + PATIENCE_S
            while not heard:
                for session in (drone, absent):
                    session.put("drone/2/state", b"forged")
                drone.put("drone/1/state", b"own")
                assert time.monotonic() < deadline
                time.sleep(POLL_S)
        del kept
    assert set(heard) == {"drone/1/state"}
