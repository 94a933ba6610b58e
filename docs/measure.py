"""Measure what the packaged scenes do, and write canprobe/scenes/expected.json. `python docs/measure.py [SCENE …]`

Each scene runs with three seeds on the lockstep bus, as `canprobe run SCENE --seed N` does; the default scene,
`cylinder`, runs with ten, for the table of the page on accuracy. Ten to fifteen minutes in all, on a machine that does
nothing else: pace and computing time are among the figures. Then `python docs/generate.py` writes them into the pages.

Of scenes that are named the figures are replaced, and the file says when and at which commit.
"""

from __future__ import annotations

import datetime
import json
import platform
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import canprobe
from canprobe.results.expected import figures_of
from canprobe.scene.load import packaged_scenes

ROOT = Path(__file__).resolve().parent.parent
FILE = ROOT / "canprobe" / "scenes" / "expected.json"
SEEDS = (0, 1, 2)
ONE_SCAN, SEEDS_OF_ONE_SCAN = "cylinder", tuple(range(10))


def between(runs: list[dict[str, float]]) -> dict[str, list[float]]:
    """Lowest and highest of each figure of some runs."""
    return {figure: [round(f(run[figure] for run in runs), 4) for f in (min, max)] for figure in runs[0]}


def measure(name: str, seeds: tuple[int, ...]) -> list[dict[str, Any]]:
    """The summaries of a scene."""
    return [canprobe.run(canprobe.load_scene(name), seed=seed, files=False).summary for seed in seeds]


def one_scan(summary: Mapping[str, Any]) -> dict[str, float]:
    """Rows of the table of one scan on the page on accuracy."""
    contact, shape, cycle = summary["contact"], summary["shape"], summary["cycle"]
    percent = 100.0 / contact["force_target_n"]
    curvature = {name: score["kappa_rms_error_percent"] for name, score in shape["methods"].items()}
    lost = ("missed_pdos", "late_pdos", "torn_frames", "stale_frames", "dropped_frames")
    return {
        "contact kept during the scan, %": 100.0 * contact["contact_fraction"],
        "contact speed, target 25 mm/s": round(1e3 * contact["speed_mean_m_s"], 2),
        "true force, RMS error, % of 2 N": round(percent * contact["force_rms_error_n"], 1),
        "true force, highest, N": round(contact["force_max_n"], 2),
        "force as the array measured it, RMS error, % of 2 N": round(
            percent * contact["force_measured_rms_error_n"], 1
        ),
        "curvature after 20 mm, RMS error of K, `recursive` (in the loop), %": round(curvature["recursive"], 1),
        "the same contacts, `ml` over the last 20 mm, %": round(curvature["ml"], 1),
        "the same contacts, `chen1996` as printed, %": round(curvature["chen1996"], 1),
        "contact normal, RMS error, degrees": round(shape["normal_rms_deg"], 2),
        "contact position, RMS error, mm": round(shape["position_rms_mm"], 2),
        "PDOs and tactile frames lost, torn or late": sum(cycle[name] for name in lost),
        "pace, × real time": round(summary["realtime_factor"], 1),
        "computing time of a cycle of 2.5 ms, median, ms": round(1e-3 * cycle["compute_us"]["p50"], 2),
        "the same, 99 %, ms": round(1e-3 * cycle["compute_us"]["p99"], 2),
        "commands out after the last TPDO, median, ms": round(1e-3 * cycle["response_us"]["p50"], 2),
        "commands out after the last TPDO, 99 %, ms": round(1e-3 * cycle["response_us"]["p99"], 2),
    }


def origin() -> dict[str, str]:
    """Commit, date and machine: processor, system and Python."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    cpuinfo = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    models = [line.partition(": ")[2] for line in cpuinfo if "model name" in line]
    return {
        "commit": commit.stdout.strip(),
        "date": datetime.date.today().isoformat(),
        "machine": f"{next(iter(models), platform.machine())}, Linux, Python {platform.python_version()}",
    }


def write(measured: Mapping[str, Any]) -> None:
    """Write the file, a line a scene."""
    parts = []
    for key, value in measured.items():
        text = json.dumps(value, ensure_ascii=False)
        if key == "scenes":
            rows = (f"    {json.dumps(name)}: {json.dumps(value[name])}" for name in sorted(value))
            text = "{\n" + ",\n".join(rows) + "\n  }"
        parts.append(f"  {json.dumps(key)}: {text}")
    FILE.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")


def main(wanted: list[str]) -> None:
    """Measure the scenes that are named, or all; the others keep their figures."""
    head = origin()
    measured = json.loads(FILE.read_text(encoding="utf-8"))
    if not wanted:
        measured = {"seeds": list(SEEDS), "bus": "lockstep", **head, "apart": {}, "one_scan": {}, "scenes": {}}
    for name, _ in packaged_scenes():
        if not wanted or name in wanted:
            summaries = measure(name, SEEDS_OF_ONE_SCAN if name == ONE_SCAN else SEEDS)
            figures = measured["scenes"][name] = between([figures_of(one) for one in summaries[: len(SEEDS)]])
            if name == ONE_SCAN:
                rows = between([one_scan(summary) for summary in summaries])
                measured["one_scan"] = {"seeds": list(SEEDS_OF_ONE_SCAN), "figures": rows}
            if wanted:
                measured["apart"][name] = head
            print(name, figures, flush=True)
    write(measured)


if __name__ == "__main__":
    main(sys.argv[1:])
