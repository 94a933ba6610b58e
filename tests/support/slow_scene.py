"""Packaged scenes for tests in real time: what does not need 400 Hz runs slower, and nothing is drawn."""

from __future__ import annotations

from pathlib import Path

from canprobe.cell.scene.load import scenes_folder


def write_slow_scene(
    path: Path, name: str, *, rate_hz: int = 100, emulated: bool = True, eds: str = "", missed_syncs: int = 20
) -> Path:
    """Write a packaged scene with another rate, with its nodes left to somebody else, or another EDS.

    A slow machine must not decide what these tests find: drives wait for `missed_syncs`, and late cycles end no run.
    Figures take longer than the runs.
    """
    extra = "" if emulated else "emulated = false\n"
    text = (
        (scenes_folder() / f"{name}.toml")
        .read_text()
        .replace("[arm]\n", f"[arm]\nmissed_syncs = {missed_syncs}\n{extra}" + (f'eds = "{eds}"\n' if eds else ""))
    )
    text = text.replace("[sensor]\n", f"[sensor]\n{extra}rate_hz = {rate_hz // 2}\n")
    text = text.replace("[scene]\n", "[outputs]\nfigures = false\n[scene]\n")
    path.write_text(f"{text}\n[cycle]\nrate_hz = {rate_hz}\n[limits]\nlate_cycles_max_percent = 100\n")
    return path
