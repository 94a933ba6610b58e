"""Serves an arm to canprobe: python arm.py 5810. In place of `pose` and `move_to` stand the calls of your arm."""

import contextlib
import json
import select
import socket
import sys
import time

PERIOD_S, STOP_AFTER_S = 0.002, 0.1
pose = [1, 0, 0, -0.12, 0, -1, 0, -0.1225, 0, 0, -1, 0.504, 0, 0, 0, 1]  # T_base_flange in rows, m


def move_to(target: list[float]) -> None:
    pose[:] = target


def serve(canprobe: socket.socket) -> None:
    canprobe.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    canprobe.sendall(json.dumps({"canprobe_arm": 1, "stop_after_ms": 1000 * STOP_AFTER_S}).encode() + b"\n")
    target, heard, rest, due = None, 0.0, b"", time.monotonic()
    while True:
        if target is not None and time.monotonic() - heard < STOP_AFTER_S:
            move_to(target)
        canprobe.sendall(json.dumps({"t_ns": time.monotonic_ns(), "T": pose}).encode() + b"\n")
        due = max(due + PERIOD_S, time.monotonic())
        while (left := due - time.monotonic()) > 0:
            if select.select([canprobe], [], [], left)[0]:
                if not (data := canprobe.recv(65536)):
                    return  # lost: the arm stops, as nothing moves it any more
                *lines, rest = (rest + data).split(b"\n")
                for message in map(json.loads, lines):
                    target, heard = None if message.get("stop") else message["T"], time.monotonic()


with socket.create_server(("127.0.0.1", int(sys.argv[1]))) as server:
    print(f"listening at 127.0.0.1:{server.getsockname()[1]}", flush=True)
    while True:
        with contextlib.suppress(OSError):  # canprobe has gone
            serve(server.accept()[0])
