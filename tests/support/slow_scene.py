"""Packaged scenes for tests in real time: what does not need 400 Hz runs slower, and nothing is drawn."""

from __future__ import annotations

from pathlib import Path

from canprobe.cell.scene.load import scenes_folder


def write_slow_scene(path: Path, name: str, *, emulated: bool = True) -> Path:
    """Write a packaged scene at 100 Hz, or with its nodes left to somebody else.

    A slow machine must not decide what these tests find: drives wait for 20 SYNCs, and late cycles end no run.
    Figures take longer than the runs.
    """
    extra = "" if emulated else "emulated = false\n"
    text = (scenes_folder() / f"{name}.toml").read_text()
    text = text.replace("[arm]\n", f"[arm]\nmissed_syncs = 20\n{extra}")
    text = text.replace("[sensor]\n", f"[sensor]\n{extra}rate_hz = 50\n")
    text = text.replace("[scene]\n", "[outputs]\nfigures = false\n[scene]\n")
    path.write_text(f"{text}\n[cycle]\nrate_hz = 100\n[limits]\nlate_cycles_max_percent = 100\n")
    return path
