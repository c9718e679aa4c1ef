"""Recordings in the hands of others: a process that is killed, an independent converter, a player that watches."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from deploy.recording_command import recording_app
from faults.recorded import Flight, team
from ground_station.recording.reader import Recording
from ground_station.recording.recorder import Recorder
from ground_station.recording.repair import repair
from protocol.errors import RecordingError

pytestmark = pytest.mark.light

LOST_S = 5.0
"""Of mission time, in real time, that a killed ground station may lose."""


def test_of_a_process_that_is_killed_all_but_the_last_seconds_can_be_repaired(root_path: Path, tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    environment = os.environ | {"PYTHONPATH": f"{root_path}:{root_path / 'tests'}"}
    command = [sys.executable, "-m", "faults.recorded", str(path)]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        told = next(int(line) for line in process.stdout if int(line) >= 110)  # 5.5 s
        process.send_signal(signal.SIGKILL)
    repaired = repair(path, tmp_path / "repaired.mcap")
    recording = Recording.open(tmp_path / "repaired.mcap")
    last = max(state.tick for state in recording.states(1))
    assert (told - last) * recording.mission.tick_s <= LOST_S
    assert repaired.duration_s == pytest.approx(last * recording.mission.tick_s)


def test_an_independent_converter_takes_a_recording_whole(tmp_path: Path) -> None:
    rerun = shutil.which("rerun", path=str(Path(sys.executable).parent))
    if rerun is None:
        pytest.skip("rerun-sdk is not installed")
    flight = Flight(team())
    with Recorder(tmp_path / "a.mcap", flight.mission, lossless=True) as recorder:
        flight.fly(recorder, range(50))
        flight.finish(recorder, 50)
    for command in (
        ["mcap", "convert", str(tmp_path / "a.mcap"), "-o", str(tmp_path / "a.rrd")],
        ["rrd", "print", str(tmp_path / "a.rrd")],
    ):
        done = subprocess.run([rerun, *command], capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr
    rows: Counter[str] = Counter()
    for count, channel, columns in re.findall(r"with (\d+) rows .* - (/\S+) - data columns: \[(.*)\]", done.stdout):
        if not (channel.startswith("/__mcap") or columns.startswith("McapChannel")):
            rows[channel] += int(count)
    rows["/tf"] //= 2  # its messages hold two transforms each
    assert rows == flight.offered
    assert "EncodedImage:blob" in done.stdout
    assert "Pinhole:image_from_camera" in done.stdout


async def test_a_player_may_watch_and_command_nothing() -> None:
    flight = Flight(team())
    with Recorder(None, flight.mission, lossless=False, foxglove_port=0) as recorder:
        address = f"ws://127.0.0.1:{recorder.foxglove_port}"
        async with connect(address, subprotocols=[Subprotocol("foxglove.sdk.v1")]) as player:
            info = json.loads(await player.recv())
            assert info["op"] == "serverInfo"
            assert info["capabilities"] == []
            channels: dict[str, dict[str, object]] = {}
            while not {"/drone/1/state", "/tf"} <= channels.keys():
                advertised = json.loads(await player.recv())
                channels |= {channel["topic"]: channel for channel in advertised.get("channels", [])}
            assert channels["/drone/1/state"]["schemaName"] == "covrecon.DroneState"
            wanted = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channels["/drone/1/state"]["id"]}]}
            await player.send(json.dumps(wanted))
            tick = 0
            while True:  # until the subscription is in force
                flight.fly(recorder, range(tick, tick + 1))
                tick += 1
                try:
                    message = await asyncio.wait_for(player.recv(), 0.1)
                except TimeoutError:
                    assert tick < 100
                    continue
                break
    assert isinstance(message, bytes)
    shown = json.loads(message[13:])  # operation, subscription and time come first
    assert shown["drone"] == 1
    assert shown["pose"] == list(flight.states[2 * shown["tick"]].pose)


def test_a_port_that_is_taken_costs_the_view_and_not_the_flight(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with Recorder(None, team(), lossless=False, foxglove_port=port) as recorder:
            assert recorder.foxglove_port is None
    assert f"Foxglove cannot watch at port {port}: " in caplog.text


def test_the_command_line_describes_and_repairs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = Flight(team())
    path = tmp_path / "recording.mcap"
    with Recorder(path, flight.mission, lossless=True) as recorder:
        flight.fly(recorder, range(200))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    recording_app(["info", str(path)], result_action="return_value")
    assert "cut short" in capsys.readouterr().out
    recording_app(["repair", str(path)], result_action="return_value")
    told = capsys.readouterr().out
    assert told.startswith(f"{tmp_path / 'recording.repaired.mcap'}: ")
    assert f"of {len(whole) // 2} bytes were torn or damaged" in told
    assert Recording.open(tmp_path / "recording.repaired.mcap").counts()
    with pytest.raises(RecordingError, match="exists already"):
        recording_app(["repair", str(path)], result_action="return_value")
