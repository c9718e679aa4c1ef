"""A camera on the network as a drone's companion sees one: RTSP with RTP inside its TCP connection, motion JPEG.

It serves RTSP 1.0 (RFC 2326, section 10.12 for the interleaving) and JPEG over RTP (RFC 2435, quantisation tables in
band). Each frame shows its number in blocks coarse enough to survive compression and resizing, and the server notes
when it sent it. It can fall silent, die, and come back at the same port.
"""

from __future__ import annotations

import random
import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import BinaryIO, Self

import cv2
import numpy as np
from numpy.typing import NDArray

RATE_HZ = 25.0
CLOCK_HZ = 90_000
"""Of RTP time stamps of JPEG, RFC 2435 section 3."""
PAYLOAD_JPEG = 26
PACKET_BYTES = 1400
"""Of JPEG in one RTP packet, as over a network."""
BITS, ROWS = 16, 2
"""A number is shown as black and white blocks, most significant bit first."""
_BLACK, _WHITE = 30, 225


def draw_number(number: int, width: int, height: int) -> NDArray[np.uint8]:
    """An image (height, width, 3) that shows ``number`` modulo 2^16."""
    bits = [(number >> (BITS - 1 - k)) & 1 for k in range(BITS)]
    blocks = np.where(np.array(bits).reshape(ROWS, -1), _WHITE, _BLACK).astype(np.uint8)
    image = cv2.resize(blocks, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.repeat(image[:, :, None], 3, axis=2)


def read_number(image: NDArray[np.uint8]) -> int:
    """The number that an image shows: of each block the middle."""
    height, width = image.shape[:2]
    columns = BITS // ROWS
    number = 0
    for k in range(BITS):
        row, column = divmod(k, columns)
        y, x = int((row + 0.5) * height / ROWS), int((column + 0.5) * width / columns)
        number = 2 * number + int(image[y - 2 : y + 3, x - 2 : x + 3].mean() > 127)
    return number


class RtspServer:
    """Serves every client its own numbers' frames, from a thread each, until it is closed."""

    def __init__(self, width: int, height: int, port: int = 0) -> None:
        """``width`` and ``height`` in pixels, multiples of 8 up to 2040; ``port`` 0: any free one."""
        self._width, self._height = width, height
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = int(self._listener.getsockname()[1])
        self.url = f"rtsp://127.0.0.1:{self.port}/camera"
        self.sent_s: dict[int, float] = {}
        """Number of each frame to the monotonic time at which it was handed to the network, to any client."""
        self.flows = threading.Event()
        """Cleared: no more frames are sent, though the connections stay."""
        self.flows.set()
        self._number = 0
        self._ended = threading.Event()
        self._sockets: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self._spawn(self._accept)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """As when it loses power, but for its operating system saying good-bye."""
        self._ended.set()
        self.flows.set()
        for open_socket in (self._listener, *self._sockets):
            with suppress(OSError):
                open_socket.shutdown(socket.SHUT_RDWR)
            open_socket.close()
        for thread in self._threads:
            thread.join()

    def _spawn(self, body: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=body, args=arguments, name="rtsp server")
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        with suppress(OSError):  # closed
            while True:
                client, _ = self._listener.accept()
                self._sockets.append(client)
                self._spawn(self._serve, client)

    # --- RTSP ----------------------------------------------------------------------------------------------------

    def _serve(self, client: socket.socket) -> None:
        session = f"{random.getrandbits(32):08x}"
        reader = client.makefile("rb")
        with suppress(OSError, ValueError):  # the client left, or this server died
            while (request := _read_request(reader)) is not None:
                method, headers = request
                answer = {"CSeq": headers.get("cseq", "0"), "Session": session}
                body = b""
                if method == "OPTIONS":
                    answer["Public"] = "OPTIONS, DESCRIBE, SETUP, PLAY, GET_PARAMETER, TEARDOWN"
                elif method == "DESCRIBE":
                    body = self._description()
                    answer |= {"Content-Type": "application/sdp", "Content-Base": self.url + "/"}
                elif method == "SETUP":
                    if "TCP" not in headers.get("transport", ""):
                        client.sendall(_response(461, "Unsupported Transport", answer, b""))
                        continue
                    answer["Transport"] = "RTP/AVP/TCP;unicast;interleaved=0-1"
                elif method == "PLAY":
                    answer["Range"] = "npt=0.000-"
                client.sendall(_response(200, "OK", answer, body))
                if method == "PLAY":
                    self._spawn(self._play, client)
                elif method == "TEARDOWN":
                    break
        reader.close()

    def _description(self) -> bytes:
        lines = [
            "v=0",
            "o=- 0 0 IN IP4 127.0.0.1",
            "s=camera",
            "c=IN IP4 0.0.0.0",
            "t=0 0",
            f"m=video 0 RTP/AVP {PAYLOAD_JPEG}",
            f"a=framerate:{RATE_HZ:g}",
            "a=control:track0",
        ]
        return "".join(f"{line}\r\n" for line in lines).encode()

    # --- RTP -----------------------------------------------------------------------------------------------------

    def _play(self, client: socket.socket) -> None:
        sequence, source = random.getrandbits(16), random.getrandbits(32)
        began_s = time.monotonic()
        frame = 0
        with suppress(OSError):
            while not self._ended.wait(max(0.0, began_s + frame / RATE_HZ - time.monotonic())):
                if not self.flows.is_set():
                    self.flows.wait()
                    frame = int((time.monotonic() - began_s) * RATE_HZ)
                stamp = int(frame * CLOCK_HZ / RATE_HZ) & 0xFFFFFFFF
                number, self._number = self._number, self._number + 1
                payloads = _rtp_payloads(self._jpeg(number), self._width, self._height)
                self.sent_s[number] = time.monotonic()
                for k, payload in enumerate(payloads):
                    marker = 0x80 if k == len(payloads) - 1 else 0
                    header = struct.pack(">BBHII", 0x80, marker | PAYLOAD_JPEG, sequence, stamp, source)
                    sequence = (sequence + 1) & 0xFFFF
                    packet = header + payload
                    client.sendall(struct.pack(">cBH", b"$", 0, len(packet)) + packet)
                frame += 1

    def _jpeg(self, number: int) -> bytes:
        options = [cv2.IMWRITE_JPEG_QUALITY, 80, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
        done, jpeg = cv2.imencode(".jpg", draw_number(number, self._width, self._height), options)
        assert done
        return jpeg.tobytes()


def _read_request(reader: BinaryIO) -> tuple[str, dict[str, str]] | None:
    """Method and headers, names in lower case; skips what the client interleaves (RTCP). None: it is gone."""
    while True:
        first = reader.read(1)
        if not first:
            return None
        if first == b"$":
            _, length = struct.unpack(">BH", reader.read(3))
            reader.read(length)
            continue
        request = (first + reader.readline()).decode()
        headers = {}
        while line := reader.readline().decode().strip():
            name, _, value = line.partition(":")
            headers[name.strip().lower()] = value.strip()
        return request.split(" ")[0], headers


def _response(code: int, phrase: str, headers: dict[str, str], body: bytes) -> bytes:
    lines = [f"RTSP/1.0 {code} {phrase}", *(f"{name}: {value}" for name, value in headers.items())]
    if body:
        lines.append(f"Content-Length: {len(body)}")
    return ("\r\n".join(lines) + "\r\n\r\n").encode() + body


def _rtp_payloads(jpeg: bytes, width: int, height: int) -> list[bytes]:
    """RFC 2435 section 3.1: headers and a piece of the scan each; the tables (section 3.1.8) with the first."""
    tables, scan = _tables_and_scan(jpeg)
    payloads = []
    for offset in range(0, len(scan), PACKET_BYTES):
        subsampled_420, tables_in_band = 1, 255
        header = struct.pack(
            ">B3sBBBB", 0, offset.to_bytes(3, "big"), subsampled_420, tables_in_band, width // 8, height // 8
        )
        if offset == 0:
            header += struct.pack(">BBH", 0, 0, len(tables)) + tables
        payloads.append(header + scan[offset : offset + PACKET_BYTES])
    return payloads


def _tables_and_scan(jpeg: bytes) -> tuple[bytes, bytes]:
    """Quantisation tables one after the other, and the entropy-coded data, of a baseline JPEG."""
    tables = b""
    at = 2  # after SOI
    while True:
        marker, length = struct.unpack_from(">HH", jpeg, at)
        segment = jpeg[at + 4 : at + 2 + length]
        at += 2 + length
        if marker == 0xFFDB:  # DQT: for each table a byte of precision and number, then 64 values
            for start in range(0, len(segment), 65):
                tables += segment[start + 1 : start + 65]
        elif marker == 0xFFDA:  # SOS: the scan follows, then EOI
            return tables, jpeg[at:-2]
