"""The screen of `canprobe console`, with Textual (extra `console`): a process beside that of the cell.

The cell runs as `canprobe console … --json`: the screen sends it the lines that somebody could type, and shows the
states that it prints. 50 times a second it asks the terminal for its cursor, and each answer renews a motion: so that
ends with the screen, the terminal, or the connection between them. A jog by a key that is held is renewed by the
repeats of that key alone.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from typing import Any, ClassVar

from rich.table import Table
from rich.text import Text
from textual import events
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.widgets import Footer, Input, RichLog, Static

from canprobe.cell.session.child_process import with_our_imports
from canprobe.cli.console_words import STEPS
from canprobe.cli.stdin import LOOK_S
from canprobe.fieldbus.bus.system import system

AXES = {"x": "x", "y": "y", "z": "z", "X": "rx", "Y": "ry", "Z": "rz"}
"""Axis of the probe by its key."""
KEYS = (
    ("left,minus", "jog('-')", "jog −"),
    ("right,plus", "jog('+')", "jog +"),
    ("up", "choose(-1)", "joint before"),
    ("down", "choose(1)", "next joint"),
    ("s", "step", "step 0.1, 1, 10"),
    ("comma", "speed(0.5)", "slower"),
    ("full_stop", "speed(2.0)", "faster"),
    ("f", "frame", "base, probe"),
    ("m", "begin('move ')", "move"),
    ("t", "begin('teach ')", "teach"),
    ("h", "home", "home"),
    ("T", "send('tare')", "tare"),
    ("e", "send('enable')", "enable"),
    ("d", "send('disable')", "disable"),
    ("r", "send('reset')", "reset"),
    ("colon", "begin('')", "command"),
    ("enter", "send('')", "go on"),
    ("q", "send('quit')", "quit"),
)
"""Keys, what they do, and how the screen names it; besides, 1 to 9, x, y, z and X, Y, Z choose what is jogged."""
DIM_COUNTS = 32
"""Counts of a taxel that are shown at full brightness where none has more."""
CHANGES = 4
"""Changes of nodes and drives that are shown."""
READ = {"voltage_v": "V", "temperature_c": "°C"}
"""Units of what is read of a drive, by its name."""
BAR = 12
"""Width of the bar of a joint's range, characters."""


class CommandLine(Input):
    """The command line; while something moves, a space is a stop there, too."""

    moves = False

    def check_consume_key(self, key: str, character: str | None) -> bool:
        return super().check_consume_key(key, character) and not (key == "space" and self.moves)


class ConsoleScreen(App[int]):
    """The screen.

    Args:
        cell: process of the cell, with pipes at stdin and stdout.

    Attributes:
        state: the state of the cell that was printed last.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("space", "send('stop')", "STOP", priority=True),
        Binding("ctrl+c", "send('quit')", "quit", priority=True, show=False),
        *(Binding(key, action, words) for key, action, words in KEYS),
        Binding("escape", "leave", "leave the line", show=False),
    ]
    CSS = """
    Horizontal, #left { height: auto; }
    #left { width: 1fr; }
    #array { width: auto; height: auto; }
    #events { height: 1fr; border-top: solid $primary; }
    Input { dock: bottom; height: 1; border: none; margin-bottom: 1; }
    """
    ENABLE_COMMAND_PALETTE = False
    AUTO_FOCUS = ""

    def __init__(self, cell: subprocess.Popen[bytes]) -> None:
        super().__init__()
        self._cell, self._text, self._open = cell, b"", True
        self.state: dict[str, Any] = {
            "state": "starts",
            "joints": (),
            "step": 1.0,
            "speed_percent": 10.0,
            "frame": "base",
        }
        self._chosen = "1"
        self._history: list[str] = []
        self._recalled = 0
        self._asked: str | None = None
        self._said = ""

    def compose(self) -> ComposeResult:
        yield Static(id="status")
        with Horizontal():
            with Vertical(id="left"):
                yield Static(id="joints")
                yield Static(id="nodes")
                yield Static(id="changes")
            yield Static(id="array")
        log = RichLog(id="events", wrap=True, max_lines=500)
        log.can_focus = False
        yield log
        yield CommandLine(placeholder=": or a key; `help` lists the commands", select_on_focus=False)
        yield Footer()

    def on_mount(self) -> None:
        self.set_interval(LOOK_S, self._look)

    def _look(self) -> None:
        """Take what the cell has printed, and ask the terminal whether it is there."""
        assert self._cell.stdout is not None
        if not self.screen.is_running:  # it is being closed
            return
        text, self._open = system.typed(self._cell.stdout.fileno())
        *lines, self._text = (self._text + text).split(b"\n")
        documents = [json.loads(line) for line in lines]
        for document in documents:
            if "says" in document and document["says"] != self._said:  # a key repeats
                self._said = document["says"]
                self.query_one(RichLog).write(Text(self._said), expand=True)
        states = [document for document in documents if "says" not in document]
        if states:
            self._show(states[-1])
        if not self._open:
            self.exit(self._cell.wait())
        elif self._driver is not None:
            self._driver.write("\x1b[6n")
            self._driver.flush()

    def on_cursor_position(self, _: events.CursorPosition) -> None:
        """The terminal has answered."""
        self.action_send("renew")

    # keys

    def on_key(self, event: events.Key) -> None:
        if isinstance(self.focused, Input):
            if event.key in ("up", "down") and self._history:
                self._recalled = min(max(self._recalled + (1 if event.key == "up" else -1), 0), len(self._history))
                line = self._history[-self._recalled] if self._recalled else ""
                self.focused.value, self.focused.cursor_position = line, len(line)
        elif event.character in AXES:
            self._chosen = AXES[event.character]
        elif event.character is not None and event.character in "123456789"[: len(self.state["joints"])]:
            self._chosen = event.character

    def action_send(self, line: str) -> None:
        """Send a line to the cell."""
        assert self._cell.stdin is not None
        if self._open:
            try:
                self._cell.stdin.write(line.encode() + b"\n")
            except OSError:  # it has ended, which its stdout says too
                self._open = False

    def action_jog(self, sign: str) -> None:
        self.action_send(f"jog {self._chosen} {sign}")

    def action_choose(self, by: int) -> None:
        count = len(self.state["joints"]) or 1
        number = int(self._chosen) if self._chosen.isdecimal() else 1
        self._chosen = str((number - 1 + by) % count + 1)

    def action_step(self) -> None:
        place = STEPS.index(f"{self.state['step']:g}") + 1
        self.state["step"] = float(STEPS[place % len(STEPS)])  # as the next state will say
        self.action_send(f"step {self.state['step']:g}")

    def action_speed(self, factor: float) -> None:
        self.state["speed_percent"] = min(max(self.state["speed_percent"] * factor, 0.5), 100.0)
        self.action_send(f"speed {self.state['speed_percent']:g}%")

    def action_frame(self) -> None:
        self.state["frame"] = "base" if self.state["frame"] == "probe" else "probe"
        self.action_send(f"frame {self.state['frame']}")

    def action_home(self) -> None:
        self.action_send(f"home {self._chosen}")

    def action_begin(self, text: str) -> None:
        """Begin a line in the command line."""
        line = self.query_one(CommandLine)
        line.value, line.cursor_position, self._recalled = text, len(text), 0
        self.set_focus(line)

    def action_leave(self) -> None:
        self.set_focus(None)

    def on_input_submitted(self, event: Input.Submitted) -> None:
        self.action_send(event.value)
        if event.value:
            self._history.append(event.value)
        event.input.clear()
        self.set_focus(None)

    # panels

    def _show(self, state: dict[str, Any]) -> None:
        self.state = state
        self.query_one(CommandLine).moves = state["state"] == "moves"
        if state["asks"] != self._asked:
            self._asked = state["asks"]
            if self._asked is not None:
                self.action_begin("")
        loads = ", ".join(f"{name} {100.0 * load:.0f} %" for name, load in state["load"].items())
        jitter = state["sync_jitter_us"]
        late = "" if jitter is None else f"   SYNC p99 {jitter[0]:.0f} µs, max {jitter[1]:.0f} µs"
        colours = {"moves": "bold yellow", "holds": "bold green", "stopped": "bold red"}
        head = Text(f"{state['state']:<9}", colours.get(state["state"], "bold"))
        head.append(
            f" jog {self._chosen}, step {state['step']:g}, {state['speed_percent']:g} % of the speed limits,"
            f" {state['frame']} frame   {loads}{late}",
            "not bold default",
        )
        self.query_one("#status", Static).update(head)
        self.query_one("#joints", Static).update(self._joints(state["joints"]))
        self.query_one("#nodes", Static).update(_nodes(state))
        self.query_one("#changes", Static).update(Text("\n".join(state["events"][-CHANGES:]), "dim"))
        self.query_one("#array", Static).update(_array(state))

    def _joints(self, joints: Sequence[dict[str, Any]]) -> Table:
        table = Table(*("joint", "actual", "target", "error", "range", "torque"), box=None, header_style="dim")
        for number, joint in enumerate(joints, 1):
            actual, low, high = joint["actual"], joint["low"], joint["high"]
            numbers = ["–" if joint[key] is None else f"{joint[key]:8.2f}" for key in ("actual", "target", "error")]
            torque = "–" if joint["torque_permille"] is None else f"{joint['torque_permille'] / 10:.1f} %"
            bar = ""
            if actual is not None:
                place = round(min(max((actual - low) / (high - low), 0.0), 1.0) * (BAR - 1))
                bar = f"{low:6.0f} {'─' * place}●{'─' * (BAR - 1 - place)} {high:.0f}"
            style = "reverse" if self._chosen == str(number) else ""
            table.add_row(f"{number} {joint['name']}, {joint['unit']}", *numbers, bar, torque, style=style)
        return table


def _nodes(state: dict[str, Any]) -> Table:
    table = Table(*("node", "", "state", "drive", "EMCY", ""), box=None, header_style="dim")
    for node in state["nodes"]:
        silent = node["heard_s"] is not None and node["heard_s"] > 0.5
        words = f"silent for {node['heard_s']:.1f} s" if silent else node["state"] or "not heard"
        style = "red" if silent or node["emcy"] else ""
        read = [f"{node[key]:.1f} {unit}" for key, unit in READ.items() if node[key] is not None]
        cells = str(node["node_id"]), node["role"], words, node["drive"] or "", node["emcy"] or "", ", ".join(read)
        table.add_row(*cells, style=style)
    return table


def _array(state: dict[str, Any]) -> Text:
    """The image of the array in colours, its force, place and age."""
    touch, taxels = state["touch"], state["taxels"]
    if touch["force_n"] is None or taxels is None:
        return Text("no array" if taxels is None else "no image")
    sigma = "" if touch["force_sigma_n"] is None else f" ± {touch['force_sigma_n']:.3f}"
    place = "no contact" if touch["u_mm"] is None else f"u {touch['u_mm']:+.1f}, v {touch['v_mm']:+.1f} mm"
    picture = Text(f"{touch['force_n']:.3f}{sigma} N, {place}\n{touch['age_cycles']} cycles old\n")
    brightest = max(DIM_COUNTS, *(taxel for row in taxels for taxel in row))
    for row in taxels:
        for taxel in row:
            share = taxel / brightest
            picture.append("  ", f"on rgb({40 + 215 * share:.0f},{30 + 150 * share:.0f},{70 - 60 * share:.0f})")
        picture.append("\n")
    return picture


def run_screen(arguments: Sequence[str]) -> int:
    """Show the screen until its cell ends.

    Args:
        arguments: those of the command line.

    Returns:
        Exit status of the cell.
    """
    with tempfile.TemporaryFile() as errors:
        cell = subprocess.Popen(
            [sys.executable, "-P", "-m", "canprobe", *arguments, "--json"],
            env=with_our_imports(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            bufsize=0,
            **system.OWN_SESSION,
        )
        try:
            ConsoleScreen(cell).run()
        finally:
            assert cell.stdin is not None
            cell.stdin.close()  # its motion brakes, and its drives are disabled
            status = cell.wait()
            errors.seek(0)
            sys.stderr.write(errors.read().decode(errors="replace"))
    return status
