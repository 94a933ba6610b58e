"""A refusal that names a way out keeps its word: what it advises is typed, and helps.

Refusals are drawn: packaged scenes with keys out of their range, with rates, modes and cells that do not go together,
with misspelt names, with values in other units, and commands on buses that they cannot have. From each refusal every
advice that can be typed is taken, as a person would read it, and typed. It has helped where the command then succeeds,
or is refused only for what the first refusal named too.
"""

from __future__ import annotations

import contextlib
import difflib
import io
import random
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from canprobe.cli import COMMANDS, main

QUICK, ALL = 6, 300
KEY, VALUE = r"[a-z_]+(?:\.[A-Za-z0-9_]+)+", r'"[^"]*"|-?[0-9][0-9.e+]*[0-9]|[0-9]|true|false'
SCANS = ("cylinder", "sphere", "plane", "axial", "foam", "saddle", "steel")
CELLS = ("puma260", "puma560", "seven-axis", "gantry", "prbt")
ARRAYS = ("inch16", "linker12x6", "poweron6x6", "uskin4x4")
RANGES: dict[str, tuple[float, float]] = {
    "task.force_n": (0.05, 10),
    "limits.force_max_n": (0.5, 10),
    "task.approach_mm_s": (1, 4),
    "limits.joint_speed_share": (0.001, 0.2),
    "cycle.compute_us": (300, 2400),
    "probe.stiffness_n_m3": (1e8, 1e10),
    "sensor.full_scale_kpa": (10, 200),
}
SCAN_RANGES: dict[str, tuple[float, float]] = RANGES | {"task.speed_mm_s": (20, 200), "task.length_mm": (5, 60)}
CHOICES: dict[str, tuple[object, ...]] = {
    "cycle.rate_hz": (100, 200, 250, 300, 410, 500, 640, 700, 800, 1000),
    "sensor.rate_hz": (30, 50, 90, 100, 150, 300, 400),
    "sensor.window": (4, 6, 8, 10),
    "sensor.mode": ("window", "image", "features"),
    "bus.bitrate": (125000, 250000, 500000, 800000),
    "bus.transmit_queue": ("fifo", "priority"),
}
MISSPELT = ("task.forc_n=2", "sensr.rate_hz=100", "task.spead_mm_s=20", "sensor.mode=featurs", "bus.bitrat=1000000")
OTHER_UNITS = (
    "object.radius_mm=0.036",
    "probe.radius_mm=0.04",
    "bus.bitrate=1000",
    "sensor.full_scale_kpa=100000",
    "bring_up.sdo_s=500",
    "sensor.pitch_mm=0.0015875",
)
ELSEWHERE = ("--bitrate 1000000", "--seed 3", "--duration 4", "--realtime", "--bus direct")


@dataclass(frozen=True)
class Answer:
    """What a command answered: its status, and what it wrote to stderr without the program's name."""

    status: int
    lines: tuple[str, ...]


def typed(words: list[str]) -> Answer:
    """Type a command, in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(words)
    lines = (re.sub(r"^canprobe[a-z ]*: ", "", line) for line in err.getvalue().splitlines())
    return Answer(status, tuple(line for line in lines if not line.startswith("warning: ")))


def drawn_plan(rng: random.Random) -> list[str]:
    """A plan of a packaged scene with one to three keys that hardly suit it."""
    scene = rng.choice((*SCANS, "press", "free"))
    ranges = SCAN_RANGES if scene in SCANS else RANGES
    words = ["plan", scene]
    if rng.random() < 0.15 and scene == "plane":
        words += ["--cell", rng.choice(CELLS)]
    if rng.random() < 0.1 and scene == "press":
        words += ["--set", f"sensor.array={rng.choice(ARRAYS)}"]
    keys = [*ranges, *CHOICES]
    if scene == "free":
        keys = ["cycle.rate_hz", "bus.bitrate", "limits.joint_speed_share", "task.swing_period_s", "cycle.compute_us"]
    for key in rng.sample(keys, rng.choice((1, 1, 2, 3))):
        low, high = (ranges | {"task.swing_period_s": (0.1, 1)}).get(key, (1, 1))
        value = rng.choice(CHOICES[key]) if key in CHOICES else f"{low * (high / low) ** rng.random():.3g}"
        words += ["--set", f"{key}={value}"]
    return words


NEWER = ("listen", "posture")
LONG_COMMANDS = [name for name in COMMANDS if len(name) > 4 and name not in NEWER]
"""Commands that are misspelt. Newer ones would make the draws of a seed others than those that were looked at."""


def misspelt(word: str, rng: random.Random) -> str:
    """A word with two letters changed places, or one left out."""
    at = rng.randrange(1, len(word) - 1)
    return rng.choice((word[:at] + word[at + 1 :], word[:at] + word[at + 1] + word[at] + word[at + 2 :]))


def drawn_words(rng: random.Random) -> list[str]:
    """A command with a name, unit or option that it does not know."""
    scene = rng.choice(SCANS)
    return rng.choice(
        (
            ["plan", misspelt(scene, rng)],
            ["plan", "plane", "--cell", misspelt(rng.choice(CELLS), rng)],
            ["plan", "listen", "--set", f"sensor.array={misspelt(rng.choice(ARRAYS), rng)}"],
            ["plan", scene, "--set", rng.choice(MISSPELT)],
            ["plan", scene, "--set", rng.choice(OTHER_UNITS)],
            ["plan", scene, "--set", f"joints.{misspelt('joint_2', rng)}.node_id=9"],
            ["plan", scene, *rng.choice(ELSEWHERE).split()],
            ["plan", scene, f"--{misspelt('rehearse', rng)}"],
            ["eds", "path", misspelt("puma260_joint", rng)],
            ["init", "new-cell", "--eds", misspelt("puma260_joint", rng)],
            [misspelt(rng.choice(LONG_COMMANDS), rng), "--help"],
            ["schema", misspelt("scene", rng)],
        )
    )


def drawn_bus(rng: random.Random) -> list[str]:
    """A command on a bus that it cannot have, or that nobody has."""
    command = rng.choice((["scan"], ["up", "free"], ["monitor", "free"], ["run", "free"], ["emulate", "free"]))
    bus = rng.choice(("lockstep", "direct", misspelt("socketcan", rng), "slcan", "kvaser", "gs_usb", "pcan", "dirct"))
    if bus in ("lockstep", "direct") and command[0] == "run":
        bus = misspelt("lockstep", rng)
    return [*command, "--bus", bus, "--channel", rng.choice(("can0", "0", "/dev/ttyACM0"))]


DRAWS: tuple[tuple[Callable[[random.Random], list[str]], int], ...] = (
    (drawn_plan, 6),
    (drawn_words, 3),
    (drawn_bus, 1),
)


def set_key(words: list[str], key: str, value: str) -> list[str]:
    """The command with a key of the scene set: in the place of a value that it had."""
    pairs = [i for i, word in enumerate(words) if word == "--set" and words[i + 1].startswith(f"{key}=")]
    rest = [word for i, word in enumerate(words) if not any(i in (at, at + 1) for at in pairs)]
    return [*rest, "--set", f"{key}={value}"]


def advice(words: list[str], lines: tuple[str, ...]) -> Iterator[tuple[str, list[str]]]:
    """Every advice of a refusal that can be typed: the line that gives it, and the command that follows it."""
    for line in lines:
        yield from ((line, command) for command in meant(words, line))
        tail = line.partition("; ")[2]
        subject = re.match(rf"({KEY}) = ", line)
        if line.startswith("  "):
            command = words
            for key in re.findall(rf"without ({KEY})", line):
                command = set_key(words, key, "")[:-2]
            for key, value in re.findall(rf"({KEY}) = ({VALUE})", line.rpartition(": load")[0]):
                command = set_key(command, key, value)
            yield line, command
            continue
        for key, value in re.findall(rf"(?:lower|raise) ({KEY}) to ({VALUE})", tail):
            yield line, set_key(words, key, value)
        for key, value in re.findall(rf"(?:take|set|or|,|\() ?({KEY}) = ({VALUE})", tail):
            yield line, set_key(words, key, value)
        if subject and (taken := re.search(r"take ([0-9.].*? Hz.*)", tail)):
            for one in taken[1].partition(", which")[0].split(" or "):
                rate, besides = one.partition(" ")[0], re.search(rf"with ({KEY}) = ({VALUE})", one)
                command = set_key(words, subject[1], rate)
                yield line, command if besides is None else set_key(command, besides[1], besides[2])
        for command in re.findall(r"`canprobe ([a-z ]+)`", line):
            yield line, command.split()
        if found := re.search(r"such as (--bus \S+ --channel \S+)|expected (--channel \S+),", line):
            options = (found[1] or found[2]).split()
            kept = [w for i, w in enumerate(words) if not {w, words[i - 1]} & {*options[::2]}]
            yield line, [*kept, *options]


def meant(words: list[str], line: str) -> Iterator[list[str]]:
    """The commands with what was meant in the place of what was typed."""
    for hint, got in re.findall(r"did you mean (.+?)(?:, for (\S+) [^?]*)?\?", line):
        if hint.startswith("--set"):
            at = next(i for i, word in enumerate(words) if word.startswith("--") and word != "--set")
            has_value = at + 1 < len(words) and not words[at + 1].startswith("--")
            yield [*words[:at], *hint.split(), *words[at + 1 + has_value :]]
            continue
        for one in hint.split(" or "):
            parts = {part for word in words for part in (word, *re.split(r"[=.]", word), *word.split("="))}
            named = {part for part in parts - {one} if re.search(rf"(?<!\w){re.escape(part)}(?!\w)", line)}
            wrong = got or max(named or parts, key=lambda part: difflib.SequenceMatcher(None, part, one).ratio())
            yield [re.sub(rf"(?<!\w){re.escape(wrong)}(?!\w)", one, word) for word in words]


def subjects(lines: tuple[str, ...]) -> set[str]:
    """What the lines of a refusal are about: their beginnings, without numbers; ways out are about nothing else."""
    lines = tuple(line for line in lines if not line.startswith("ways out"))
    return {re.sub(r"[0-9.]+|\".*?\"", "", re.split(r": | = ", line)[0]) for line in lines if not line.startswith("  ")}


def failure(words: list[str], refusal: Answer, line: str, command: list[str]) -> str | None:
    """How an advice does not keep its word; None where it does."""
    then = typed(command)
    if then.status == 0 or (then.status == 3 and "`canprobe adapters`" in line):  # no such bus here, which it shows
        return None
    repeated = line in then.lines and not line.startswith("  ")
    besides = {"bus can at  bit/s"} if "which the bus has no room for" in line else set()
    besides |= set(re.findall(KEY, line.partition(", which asks for another ")[2]))
    announced = subjects(then.lines) <= subjects(refusal.lines) | besides or "(for `run`)" in line
    if announced and not repeated and (line.startswith("  ") or then.lines != refusal.lines):
        return None
    return f"{' '.join(words)}\n  said  {line}\n  typed {' '.join(command)}\n  got   " + "\n        ".join(then.lines)


def refusals(seed: int, count: int) -> Iterator[tuple[list[str], Answer]]:
    """Drawn commands that are refused, and what they answered."""
    rng = random.Random(seed)
    draws, weights = zip(*DRAWS, strict=True)
    while count:
        words = rng.choices(draws, weights)[0](rng)
        if (answer := typed(words)).status != 0:
            count -= 1
            yield words, answer


def check(seed: int, count: int, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.chdir(folder)
    failures, tried = [], 0
    for words, answer in refusals(seed, count):
        assert answer.lines and answer.status in (2, 3), f"{words}: {answer}"
        for line, command in advice(words, answer.lines):
            tried += 1
            if (wrong := failure(words, answer, line, command)) is not None:
                failures.append(wrong)
    assert not failures, f"seed {seed}: {len(failures)} of {tried}\n" + "\n".join(failures)
    assert tried > count / 2


def test_what_a_refusal_advises_helps(monkeypatch, tmp_path):
    check(7, QUICK, monkeypatch, tmp_path)


@pytest.mark.slow(reason="hundreds of refusals")
@pytest.mark.timeout(3600)
def test_what_many_refusals_advise_helps(monkeypatch, tmp_path):
    check(1, ALL, monkeypatch, tmp_path)
