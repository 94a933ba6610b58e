"""A refusal that names a way out keeps its word: what it advises is typed, and helps."""

from __future__ import annotations

import re

import pytest

from canprobe.cli import main


def plan(scene: str, keys: dict[str, str]) -> int:
    return main(["plan", scene, *(f"--set={key}={value}" for key, value in keys.items())])


@pytest.mark.parametrize(
    ("scene", "keys", "advised"),
    [
        ("cylinder", {"cycle.rate_hz": "2000"}, {"cycle.rate_hz": r"^  cycle\.rate_hz = (\S+):"}),
        ("cylinder", {"cycle.compute_us": "2400"}, {"cycle.compute_us": r"^  cycle\.compute_us = (\S+):"}),
        (
            "cylinder",
            {"bus.bitrate": "250000"},
            {"cycle.rate_hz": r"^  cycle\.rate_hz = (\S+) with", "sensor.rate_hz": r"with sensor\.rate_hz = (\S+):"},
        ),
        (
            "cylinder",
            {"sensor.mode": "image"},
            {"bus.fd": r"bus\.fd = (true)", "sensor.eds": r'sensor\.eds = "(\S+)":'},
        ),
        (
            "press",
            {"cycle.rate_hz": "500", "sensor.rate_hz": "250"},
            {"arm.grouped_rpdo": r"^  arm\.grouped_rpdo = (true) and", "bus.cob_ids": r'bus\.cob_ids = "(\S+)":'},
        ),
        ("press", {"bus.transmit_queue": "fifo"}, {"bus.transmit_queue": r'\(bus\.transmit_queue = "(\S+)"\):'}),
        (
            "cylinder",
            {"cycle.rate_hz": "410"},
            {"cycle.rate_hz": r"take (\S+) Hz with", "sensor.rate_hz": r"take \S+ Hz with sensor\.rate_hz = (\S+) or"},
        ),
        ("cylinder", {"sensor.rate_hz": "90"}, {"sensor.rate_hz": r"take (\S+) or \S+ Hz"}),
        ("cylinder", {"task.speed_mm_s": "150"}, {"task.speed_mm_s": r"lower task\.speed_mm_s to ([\d.]+),"}),
        ("cylinder", {"sensor.full_scale_kpa": "20"}, {"task.force_n": r"lower task\.force_n to ([\d.]+),"}),
        (
            "cylinder",
            {"sensor.full_scale_kpa": "10"},
            {"sensor.full_scale_kpa": r"take an array with sensor\.full_scale_kpa = ([\d.]+)"},
        ),
        ("cylinder", {"task.force_n": "0.05"}, {"task.force_n": r"raise task\.force_n to ([\d.]+)"}),
        ("free", {"task.swing_period_s": "0.1"}, {"task.swing_period_s": r"\(task\.swing_period_s = ([\d.]+)\)"}),
    ],
)
def test_what_a_refusal_advises_helps(scene, keys, advised, capsys):
    assert plan(scene, keys) == 2
    said = capsys.readouterr().err.replace("canprobe: ", "")
    typed = {key: re.search(pattern, said, re.MULTILINE)[1] for key, pattern in advised.items()}
    assert plan(scene, keys | typed) == 0, typed
