"""A controller of Universal Robots as a client sees it: RTDE, dashboard and script port, and a flange that follows.

    python ur_controller.py HOST [--version 5.11] [--at X Y Z RX RY RZ] [--clock-s SECONDS]

RTDE after "Real-Time Data Exchange (RTDE) Guide" (docs.universal-robots.com), protocol version 2, port 30004: version,
recipes of outputs and inputs with their types, start, pause, data packages. Nothing executes URScript: once a program
is sent to port 30003, the controller acts as the one that ur_rtde sends, by its commands in the input registers. It
knows `servoL`, `servoStop`, `setTcp`, `setWatchdog` and `stopScript`; no other may come. The flange follows the target
of `servoL` with a first-order lag of the lookahead time, and has no kinematics.

Its clock is its own, as a real one's: seconds since power-on. Each event is a line of JSON on stdout.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import struct
from typing import Any

from scipy.spatial.transform import Rotation

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
VERSION_REQUEST, VERSION_OF_CONTROLLER, DATA = b"V", b"v", b"U"
OUTPUTS, INPUTS, START, PAUSE = b"O", b"I", b"S", b"P"
FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "UINT32": "I", "INT32": "i"}
STOPPED, PLAYING = 1, 2
POWERED, PROGRAM_RUNS = 1, 2  # bits of robot_status_bits
NORMAL = 1  # bit of safety_status_bits
NO_COMMAND, SERVO_STOP, SERVO, SET_TCP, SET_WATCHDOG, STOP_SCRIPT = 0, 16, 24, 29, 35, 255
READY, DONE = 1, 2


def type_of(name: str) -> str:
    """RTDE's type of a field, or NOT_FOUND."""
    if "double_register" in name or name == "timestamp":
        return "DOUBLE"
    if "int_register" in name:
        return "INT32"
    if name in ("actual_TCP_pose", "external_force_torque"):
        return "VECTOR6D"
    return "UINT32" if name in ("robot_status_bits", "safety_status_bits", "runtime_state") else "NOT_FOUND"


def types_of(names: list[str]) -> list[str]:
    return [type_of(name) for name in names]


def layout(names: list[str]) -> struct.Struct:
    return struct.Struct(">" + "".join(FORMATS[kind] for kind in types_of(names)))


def names_of(text: bytes) -> list[str]:
    return [name for name in text.decode("ascii").split(",") if name]


class Controller:
    """What all connections share."""

    def __init__(self, version: tuple[int, int], pose: list[float], clock_s: float) -> None:
        self.version, self.rate_hz = version, 500.0 if version[0] >= 5 else 125.0
        self.flange, self.target, self.lookahead_s = pose, pose, 0.1
        self.servos = False
        self.fields: dict[str, Any] = {"timestamp": clock_s, "safety_status_bits": NORMAL, "runtime_state": STOPPED}
        self.served = self.silent_s = 0.0
        self.longest_s = math.inf
        self.done = False

    def say(self, event: str, **more: Any) -> None:
        print(json.dumps({"event": event, "t_s": self.fields["timestamp"], "flange": self.flange, **more}), flush=True)

    def begin(self, program: bytes) -> None:
        """A program has come."""
        self.say("program", octets=len(program))
        self.fields["runtime_state"], self.longest_s, self.silent_s, self.done = PLAYING, math.inf, 0.0, False
        self.fields["output_int_register_0"] = READY

    def end(self, why: str) -> None:
        """The program ends, and with it the motion."""
        self.say("end", why=why)
        self.fields["runtime_state"], self.servos = STOPPED, False

    def write(self, names: list[str], values: tuple[Any, ...]) -> None:
        """Inputs have come: the program acts on its command."""
        fields = self.fields
        fields.update(zip(names, values, strict=True))
        if "input_int_register_0" in names:
            self.silent_s = 0.0
        if fields["runtime_state"] != PLAYING:
            return
        command = fields.get("input_int_register_0", NO_COMMAND)
        numbers = [fields.get(f"input_double_register_{i}", 0.0) for i in range(11)]
        if command == NO_COMMAND:
            self.done, fields["output_int_register_0"] = False, READY
        elif command == SERVO:
            if not self.servos:
                self.say("servo")
            self.servos, self.target, self.lookahead_s = True, numbers[:6], numbers[9]
        elif not self.done:
            self.done, fields["output_int_register_0"] = True, DONE
            if command == SERVO_STOP:
                self.servos = False
                self.say("servo stop")
            elif command == SET_TCP:
                self.say("tcp", pose=numbers[:6])
            elif command == SET_WATCHDOG:
                self.longest_s = 1.0 / numbers[0]
                self.say("watchdog", longest_s=self.longest_s)
            elif command == STOP_SCRIPT:
                self.end("stop")
            else:
                self.end(f"unknown command {command}")

    def step(self, dt: float) -> None:
        """Move the controller's time on."""
        self.fields["timestamp"] += dt
        self.silent_s += dt
        if self.fields["runtime_state"] == PLAYING and self.silent_s > self.longest_s:
            self.end("watchdog")
        if not self.servos:
            return
        share = -math.expm1(-dt / self.lookahead_s)
        here, there = (Rotation.from_rotvec(pose[3:]) for pose in (self.flange, self.target))
        turned = Rotation.from_rotvec(share * (there * here.inv()).as_rotvec()) * here
        moved = [a + share * (b - a) for a, b in zip(self.flange[:3], self.target[:3], strict=True)]
        self.flange = [*moved, *turned.as_rotvec().tolist()]

    def output(self, names: list[str]) -> list[Any]:
        """Values of a recipe, flat."""
        runs = self.fields["runtime_state"] == PLAYING
        now = {**self.fields, "robot_status_bits": POWERED | PROGRAM_RUNS * runs}
        values: list[Any] = []
        for name in names:
            values += self.flange if name == "actual_TCP_pose" else [now.get(name, 0)]
        return values

    async def run(self) -> None:
        """Keep the time; what the machine held up is made good in steps of the cycle."""
        loop, dt = asyncio.get_running_loop(), 1.0 / self.rate_hz
        origin = loop.time()
        while True:
            while self.served < loop.time() - origin:
                self.served += dt
                self.step(dt)
            await asyncio.sleep(dt)


class Client:
    """One RTDE connection: its recipes, and whether it is sent data."""

    def __init__(self, controller: Controller, writer: asyncio.StreamWriter) -> None:
        self.controller, self.writer = controller, writer
        self.outputs: list[str] = []
        self.inputs: list[list[str]] = []
        self.period_s = 0.0
        self.stream: asyncio.Task[None] | None = None

    def send(self, kind: bytes, payload: bytes) -> None:
        self.writer.write(struct.pack(">Hc", 3 + len(payload), kind) + payload)

    def receive(self, kind: bytes, payload: bytes) -> None:
        if kind == VERSION_REQUEST:
            self.send(kind, bytes([payload == b"\0\2"]))
        elif kind == VERSION_OF_CONTROLLER:
            self.send(kind, struct.pack(">4I", *self.controller.version, 0, 0))
        elif kind == OUTPUTS:
            self.period_s = max(1.0 / struct.unpack_from(">d", payload)[0], 1.0 / self.controller.rate_hz)
            self.outputs = names_of(payload[8:])
            self.send(kind, b"\1" + ",".join(types_of(self.outputs)).encode())
        elif kind == INPUTS:
            self.inputs.append(names_of(payload))
            self.send(kind, bytes([len(self.inputs)]) + ",".join(types_of(self.inputs[-1])).encode())
        elif kind == START:
            self.send(kind, b"\1")
            self.stream = asyncio.ensure_future(self.serve())
        elif kind == PAUSE:
            self.close()
            self.send(kind, b"\1")
        elif kind == DATA:
            names = self.inputs[payload[0] - 1]
            self.controller.write(names, layout(names).unpack(payload[1:]))

    async def serve(self) -> None:
        packed = layout(self.outputs)
        while True:
            self.send(DATA, b"\1" + packed.pack(*self.controller.output(self.outputs)))
            await asyncio.sleep(self.period_s)

    def close(self) -> None:
        if self.stream is not None:
            self.stream.cancel()


async def serve(host: str, controller: Controller) -> None:
    async def rtde(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = Client(controller, writer)
        try:
            while True:
                size, kind = struct.unpack(">Hc", await reader.readexactly(3))
                client.receive(kind, await reader.readexactly(size - 3))
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            client.close()
            writer.close()

    async def script(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        program = b""
        while chunk := await reader.read(65536):
            program += chunk
            if program.endswith(b"end\n") and program.startswith(b"def "):
                controller.begin(program)
                program = b""
        writer.close()

    async def dashboard(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        major, minor = controller.version
        answers = {
            "polyscopeversion": f"URSoftware {major}.{minor}.0.0 (Jan 01 2022)",
            "get serial number": "20000000001",
            "is in remote control": "true",
            "stop": "Stopped",
        }
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        while line := await reader.readline():
            writer.write(f"{answers[line.decode().strip().lower()]}\n".encode())
        writer.close()

    for port, answer in ((RTDE_PORT, rtde), (SCRIPT_PORT, script), (DASHBOARD_PORT, dashboard)):
        await asyncio.start_server(answer, host, port)
    controller.say("ready")
    await controller.run()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("host")
    parser.add_argument("--version", default="5.11")
    parser.add_argument("--at", type=float, nargs=6, default=[0.4, 0.1, 0.3, 3.1, 0.1, 0.0])
    parser.add_argument("--clock-s", type=float, default=86_400.0)
    given = parser.parse_args()
    major, minor = map(int, given.version.split("."))
    asyncio.run(serve(given.host, Controller((major, minor), given.at, given.clock_s)))


if __name__ == "__main__":
    main()
