"""Measure what the packaged scenes do, and write canprobe/scenes/expected.json. `python docs/measure.py [SCENE …]`

Each scene runs with three seeds on the lockstep bus, as `canprobe run SCENE --seed N` does: ten minutes in all. Then
`python docs/generate.py` writes the figures into the page on scenes.
"""

from __future__ import annotations

import datetime
import json
import platform
import subprocess
import sys
from pathlib import Path

import canprobe
from canprobe.results.expected import figures_of
from canprobe.scene.load import packaged_scenes

ROOT = Path(__file__).resolve().parent.parent
FILE = ROOT / "canprobe" / "scenes" / "expected.json"
SEEDS = (0, 1, 2)


def measure(name: str) -> dict[str, list[float]]:
    """Lowest and highest of each figure of a scene."""
    runs = [figures_of(canprobe.run(canprobe.load_scene(name), seed=seed, files=False).summary) for seed in SEEDS]
    return {figure: [round(f(run[figure] for run in runs), 4) for f in (min, max)] for figure in runs[0]}


def machine() -> str:
    """Processor, system and Python."""
    models = [
        line.partition(": ")[2] for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line
    ]
    return f"{next(iter(models), platform.machine())}, Linux, Python {platform.python_version()}"


def main(wanted: list[str]) -> None:
    """Measure the scenes that are named, or all; the others keep their figures."""
    scenes = json.loads(FILE.read_text(encoding="utf-8"))["scenes"] if FILE.exists() and wanted else {}
    for name, _ in packaged_scenes():
        if not wanted or name in wanted:
            scenes[name] = measure(name)
            print(name, scenes[name], flush=True)
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    rows = ",\n".join(f"    {json.dumps(name)}: {json.dumps(scenes[name])}" for name in sorted(scenes))
    head = {
        "seeds": list(SEEDS),
        "bus": "lockstep",
        "commit": commit.stdout.strip(),
        "date": datetime.date.today().isoformat(),
        "machine": machine(),
    }
    lines = "".join(f"  {json.dumps(key)}: {json.dumps(value)},\n" for key, value in head.items())
    FILE.write_text(f'{{\n{lines}  "scenes": {{\n{rows}\n  }}\n}}\n', encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
