"""Draw docs/img/console.svg: the screen of `canprobe console press`, with the probe on the object.

`python docs/measure.py screens` does it. A session in virtual time jogs joint 3 until the probe touches; the screen
gets what it has printed.
"""

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import canprobe
from canprobe.api import Observation
from canprobe.cli.console_screen import ConsoleScreen
from canprobe.cli.console_words import Words
from canprobe.cli.hand_session import HandSession

SIZE = 118, 38
FORCE_N = 0.04
"""Force at which the picture is taken; at `limits.jog_force_n` the probe goes back."""
STEP_NS = 300_000_000
"""Time of a step."""


def printed() -> list[Any]:
    """What the session prints until the probe touches, texts and states."""
    shown: list[Any] = []

    def observe(observation: Observation) -> None:
        session.view.observe(observation)

    cell = canprobe.open_cell("press", bus="lockstep", rows_kept=1, say=shown.append, observers=[observe])
    session = HandSession(cell, shown.append, Path("press"), paced=False)

    def lines() -> Iterator[str | None]:
        yield from ("enable", "yes")
        while shown[-1] is not state() or state()["state"] != "holds":
            yield None
        yield "step 0.1"
        while not (force := state()["touch"]["force_n"]) or force < FORCE_N:
            yield "jog 3 +"
            until_ns = session.view.seen.t_ns + STEP_NS
            while session.view.seen.t_ns < until_ns:
                yield "renew"

    def state() -> dict[str, Any]:
        return next(one for one in reversed(shown) if isinstance(one, dict))

    script = lines()

    def typed() -> tuple[bytes, bool]:
        line = next(script, "quit")
        return b"" if line is None else line.encode() + b"\n", True

    session.take = Words(session, typed, shown.append).take
    with cell:
        session.run()
    last = max(i for i, one in enumerate(shown) if isinstance(one, dict) and one["state"] == "holds")
    return shown[: last + 1]


async def draw_console(path: Path) -> None:
    """Draw the screen after the last state."""
    lines = [json.dumps({"says": one} if isinstance(one, str) else one) for one in printed()]
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as cell:
        screen = ConsoleScreen(cell)
        async with screen.run_test(size=SIZE) as pilot:
            os.write(cell.stdin.fileno(), "".join(f"{line}\n" for line in lines if "says" in line).encode())
            os.write(cell.stdin.fileno(), lines[-1].encode() + b"\n")
            while not screen.state["joints"]:
                await pilot.pause()
            await pilot.press("3")
            os.write(cell.stdin.fileno(), lines[-1].encode() + b"\n")
            await pilot.pause(0.5)
            path.write_text(screen.export_screenshot(title="canprobe console press"), encoding="utf-8")
