"""Measure what the pages say, and write docs/measured.json. `python docs/measure.py [NAME …]`

A name is that of a packaged scene, of a study, or one of `OTHERS` below: `one_scan`, `whole_cell`, `vcan0`, `pace`,
`side_by_side`, `growth`, `held`, `gym`, `learning`, `bridges`, `local_node`, `canopen_node`, `canopen_node_vcan`,
`hard_cases`, `first_hour`, `test_lines`, `pictures`, `screens`, one of `FORMS`, or one of `PRINTED`, what a page shows
of a command that the tests repeat. Without names everything is measured but what takes more than half an hour or needs
clones (`LONG`). Measure on a machine that does nothing else: computing time is among the figures. Every entry has its
own command, date, commit and machine, so that one can be measured anew without the others; an entry whose study is gone
stays with its commit. Then `python docs/generate.py` writes the pages.
"""

from __future__ import annotations

import ast
import asyncio
import contextlib
import datetime
import hashlib
import io
import json
import os
import platform
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import hard_cases
from gallery import draw_panel
from moving_picture import draw_moving
from PIL import Image
from report_pictures import draw_reports
from view_picture import draw_view

import canprobe
from canprobe.cell.results.expected import figures_of
from canprobe.cell.results.figures import draw_run
from canprobe.cell.results.surface_figure import draw_surface
from canprobe.cell.scene.load import packaged
from canprobe.lab.studies.result import processor
from canprobe.lab.studies.sweep import STUDIES

DOCS = Path(__file__).resolve().parent
IMAGES = DOCS / "img"
FILE = DOCS / "measured.json"
RUNS = DOCS.parent / "runs" / "measured"
"""Where studies and runs on vcan0 leave their files; finished cells of a study are used again."""
SEEDS, SEEDS_OF_ONE_SCAN = (0, 1, 2), range(10)
IN_GUEST = "canprobe vcan --realtime -- "
ON_VCAN0 = "canprobe run cylinder --bus socketcan --channel vcan0 --realtime --patient"
BENCH = "python -m pytest -n0 --benchmark-only tests/bench/"
LONG = ("faults", "test_lines", "soak", "growth", "held", "canopen_node", "canopen_node_vcan")
FORMS = {
    "faults": "faults --draw=1",
    "bound": "estimators",
    "calibrations": "calibration",
    "exploration": "surfaces",
    "link": "realtime --link",
    "soak": "realtime --soak",
    "recover": "faults --recover",
    "recover_vcan": "faults --recover --vcan",
    "faults_vcan": "faults --vcan",
}
"""Other forms of a study, and further tables of one that have their own place on a page, as they are typed."""
ON_VCAN0_ONLY = ("realtime", "soak", "recover_vcan", "faults_vcan")
INTERPRETED = {"python": [sys.executable], "canprobe": [sys.executable, "-m", "canprobe"]}
COLOURS = 256
"""Of a picture in the documentation."""

Entry = dict[str, Any]
Row = Mapping[str, Any]
Columns = Mapping[str, str]
"""Headings, each with the form that a row of a study's result is printed in."""

TABLES: Mapping[str, tuple[Callable[[Sequence[Row]], Sequence[Row]], Columns]] = {
    "regions": (
        lambda rows: [row for row in rows if row["group"] in ("kind", "behind a jump", "array", "speed", "force")],
        {
            "scenes by": "{group}",
            "of": "{of}",
            "scenes (refused, stopped)": "{scenes} ({refused}, {stopped})",
            "observed": "{observed:.1%}",
            "regions that hold the truth": "{coverage:.1%} ({coverage_low:.1%} to {coverage_high:.1%})",
            "scenes below 80 %": "{below_80:.1%}",
            "below 40 %": "{below_40:.1%}",
            "stated over error": "{stated_over_error:.2f} ({stated_low:.2f} to {stated_high:.2f})",
            "error, 1/m": "{error_per_m:.2f}",
            "log score": "{log_score:.2f}",
            "forces within 2σ": "{force:.1%}",
            "heights within 2σ, and relative": "{bands:.1%}, {relative_bands:.1%}",
            "worst scene": "{worst}",
        },
    ),
    "exploration": (
        lambda rows: rows,
        {
            "strategy": "{strategy}",
            "path to 20 µm": "{height_mm:.0f} mm",
            "time": "{height_s:.1f} s",
            "path to 3 mrad": "{normal_mm:.0f} mm",
            "path to 2 1/m": "{curvature_mm:.0f} mm",
            "reached": "{reached}",
            "force off its target": "{force_percent:.1f} %",
            "in contact": "{contact:.1%}",
            "stopped": "{stopped}",
        },
    ),
    "faults": (
        lambda rows: sorted(rows, key=lambda row: -row["force_max_n"]),
        {
            "fault": "{fault}",
            "runs": "{runs}",
            "highest true force": "{force_max_n:.1f} N",
            "in": "{worst}",
            "noticed after (median, longest)": "{noticed_ms:.0f}, {noticed_max_ms:.0f} ms",
            "not noticed": "{unnoticed}",
            "completed": "{completed}",
            "left pressing, with up to": "{pressing}, {left_n:.1f} N",
            "cause named": "{named:.0f}%",
            "failures": "{failures}",
        },
    ),
    "surfaces": (
        lambda rows: [
            min((row for row in rows if row["method"] == name), key=lambda row: row["curvature_per_m"])
            for name in dict.fromkeys(row["method"] for row in rows)
        ],
        {
            "method, at its best setting": "{method}, {setting:g} {unit}",
            "ground known": "{known:.0%}",
            "height, µm": "{height_um:.1f}",
            "normals, mrad": "{normal_mrad:.1f}",
            "curvature, 1/m": "{curvature_per_m:.2f}",
            "bands that hold the truth": "{coverage:.0%}",
            "time, s": "{cpu_s:.2f}",
        },
    ),
    "bridges": (
        list,
        {
            "bridge": "{bridge}",
            "watched": "{watched}",
            "added to a cycle of 2500 µs, median, 99 %": "{added_p50_us:.0f}, {added_p99_us:.0f} µs",
            "dropped of": "{dropped} of {samples}",
            "its process, of one processor": "{processor_percent:.0f}%",
            "extra, installed": "{installed_mb:.0f} MB",
        },
    ),
}
"""Rows and columns of a study's table that its page shows; of the other studies it shows the findings only."""


def origin() -> Entry:
    """Date, commit and machine, as they are when a measurement begins."""
    git = ["git", "-C", str(DOCS.parent)]
    commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", "canprobe", "bridge", "eds", "tests"], check=False)
    cores = len(os.sched_getaffinity(0))
    return {
        "date": datetime.date.today().isoformat(),
        "commit": commit.stdout.strip() + ("-dirty" if changed.returncode else ""),
        "machine": f"{processor()}, {cores} cores, Python {platform.python_version()}",
    }


def printed(command: str) -> str:
    """Run a command of canprobe or Python with this interpreter, and what it prints."""
    words = [w for word in shlex.split(command) for w in INTERPRETED.get(word, [word])]
    done = subprocess.run(words, cwd=DOCS.parent, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{done.stdout}\n{command}: ended with status {done.returncode}")
    return done.stdout


def between(runs: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    """Lowest and highest of each figure of some runs."""
    return {figure: [round(f(run[figure] for run in runs), 4) for f in (min, max)] for figure in runs[0]}


def scene(name: str) -> Entry:
    """Figures of a packaged scene."""
    runs = [canprobe.run(name, seed=seed, files=False).summary for seed in SEEDS]
    return {
        "command": "python docs/measure.py",
        "seeds": list(SEEDS),
        "figures": between([figures_of(run) for run in runs]),
    }


def one_scan() -> Entry:
    """The default scan in lockstep."""
    runs = [canprobe.run("cylinder", seed=seed, files=False).summary for seed in SEEDS_OF_ONE_SCAN]
    return {"command": "canprobe run cylinder --seed 0 … --seed 9", "table": _scan_table(runs)}


def whole_cell() -> Entry:
    """Errors of the whole cell against its computing time, over plant, rate and estimator: medians of three seeds."""
    keys = {
        "plant.fidelity": ["ideal", "dynamic"],
        "cycle.rate_hz": [200, 400],
        "shape.method": ["chord", "recursive", "ml"],
    }
    many = canprobe.run_many(
        "cylinder", keys, seeds=3, bus="direct", duration_s=5.0, workers=1, out=RUNS / "whole_cell"
    )
    runs = many.table()
    runs["pace"] = 1e3 * runs["wall_time_s"] / runs["sim_time_s"]
    runs["force"] = 100.0 * runs["contact.force_true_rms_error_n"] / runs["contact.force_target_n"]
    errors = ["shape.kappa_rms_error_percent", "shape.normal_rms_deg", "force"]
    medians = runs.groupby(list(keys), sort=False)[["pace", *errors]].median().reset_index()
    head = [
        "plant",
        "rate",
        "estimator",
        "a second of the scan",
        "curvature, RMS",
        "normal, RMS",
        "measured force, RMS",
    ]
    form = "{} | {} Hz | `{}` | {:.0f} ms | {:.1f} % | {:.3f}° | {:.1f} %"
    table = [form.format(*row).split(" | ") for row in medians.itertuples(index=False)]
    return {"command": "python docs/measure.py whole_cell", "table": [head, *table]}


def vcan0() -> Entry:
    """The same on a real vcan0."""
    folders = [RUNS / "vcan0" / str(seed) for seed in SEEDS_OF_ONE_SCAN]
    for seed, folder in zip(SEEDS_OF_ONE_SCAN, folders, strict=True):
        printed(f"{IN_GUEST}{ON_VCAN0} --force --seed {seed} --out {folder}")
    runs = [json.loads((folder / "summary.json").read_text(encoding="utf-8")) for folder in folders]
    table = [row for row in _scan_table(runs) if not row[0].startswith("pace")]
    return {"command": f"{IN_GUEST}{ON_VCAN0} --seed 0 … --seed 9", "table": table}


def _scan_table(runs: Sequence[Row]) -> list[list[str]]:
    spread = between([_scan_figures(run) for run in runs])
    rows = [[what, f"{low:g}{'' if low == high else f'–{high:g}'}"] for what, (low, high) in spread.items()]
    return [["figure", "lowest to highest of the seeds"], *rows]


def _scan_figures(summary: Row) -> dict[str, float]:
    contact, shape, cycle = summary["contact"], summary["shape"], summary["cycle"]
    percent = 100.0 / contact["force_target_n"]
    curvature = {name: score["kappa_rms_error_percent"] for name, score in shape["methods"].items()}
    lost = ("missed_pdos", "late_pdos", "torn_frames", "stale_frames", "dropped_frames")
    return {
        "contact kept during the scan, %": round(100.0 * contact["contact_fraction"], 1),
        "contact speed, target 25 mm/s": round(1e3 * contact["speed_mean_m_s"], 2),
        "true force off its target, RMS, % of 2 N": round(percent * contact["force_rms_error_n"], 1),
        "measured force less true, RMS, % of 2 N": round(percent * contact["force_true_rms_error_n"], 1),
        "true force, highest, N": round(contact["force_max_n"], 2),
        "measured force off its target, RMS, % of 2 N": round(percent * contact["force_measured_rms_error_n"], 1),
        "curvature after 20 mm, RMS error of K, `recursive` (in the loop), %": round(curvature["recursive"], 1),
        "the same contacts, `ml` over the last 20 mm, %": round(curvature["ml"], 1),
        "the same contacts, `chen1996` as printed, %": round(curvature["chen1996"], 1),
        "contact normal, RMS error, degrees": round(shape["normal_rms_deg"], 2),
        "contact position, RMS error, mm": round(shape["position_rms_mm"], 2),
        "PDOs and tactile frames lost, torn or late": sum(cycle[name] for name in lost),
        "cycles a second": round(cycle["rate_hz"], 1),
        "overruns": cycle["overruns"],
        "pace, × real time": round(summary["realtime_factor"], 1),
        "computing time of a cycle of 2.5 ms, median, ms": round(1e-3 * cycle["compute_us"]["p50"], 2),
        "the same, 99 %, ms": round(1e-3 * cycle["compute_us"]["p99"], 2),
        "commands out after the last TPDO, median, ms": round(1e-3 * cycle["response_us"]["p50"], 2),
        "commands out after the last TPDO, 99 %, ms": round(1e-3 * cycle["response_us"]["p99"], 2),
    }


def study(name: str) -> Entry:
    """Findings and table of a study; its pictures, where the pages show them, are drawn anew."""
    command = f"canprobe study {FORMS.get(name, name)}"
    if name in ON_VCAN0_ONLY:
        command = IN_GUEST + command
    out = RUNS / FORMS.get(name, name).replace(" --", "-")
    printed(f"{command} --out {out}")
    entry = {"command": command} | _found(name, json.loads((out / f"{name}.json").read_text(encoding="utf-8")))
    shown = [picture.name for picture in out.glob("*.png") if (IMAGES / picture.name).exists()]
    for picture in shown:
        whole = Image.open(out / picture).convert("RGB")
        whole.quantize(COLOURS, Image.Quantize.MAXCOVERAGE).save(IMAGES / picture, optimize=True)
    return entry | ({"pictures": {picture: picture_digest(picture) for picture in shown}} if shown else {})


def _found(name: str, result: Row) -> Entry:
    """Findings and table of a study's document."""
    parts = (result, *(part for part in result.get("more", ()) if part["study"] not in FORMS))
    entry: Entry = {"findings": [line for part in parts for line in part["findings"]]}
    if name in TABLES:
        chosen, columns = TABLES[name]
        rows = ([_cell(form, row) for form in columns.values()] for row in chosen(result["rows"]))
        entry["table"] = [list(columns), *rows]
    return entry


def _cell(form: str, row: Row) -> str:
    try:
        text = form.format_map({key.replace(".", "_"): value for key, value in row.items()})
        return text.replace("%", " %").replace("  ", " ")
    except TypeError:  # None: does not apply
        return "–"


def bench(file: str) -> list[Row]:
    """What pytest-benchmark measures of a file of `tests/bench`."""
    with tempfile.NamedTemporaryFile(suffix=".json") as written:
        printed(f"{BENCH}{file} --benchmark-json={written.name}")
        benchmarks: list[Row] = json.loads(Path(written.name).read_text(encoding="utf-8"))["benchmarks"]
    return benchmarks


def bench_table(name: str) -> Entry:
    """The table of a file of `tests/bench`; of several with the same headings, the rows of all."""
    file = f"test_bench_{name}.py"
    tables = [one["extra_info"]["table"] for one in bench(file)]
    return {"command": f"{BENCH}{file} -s", "table": [tables[0][0], *(row for table in tables for row in table[1:])]}


def gym() -> Entry:
    """What a step of the environment costs."""
    file = "test_bench_gym.py"
    ms = {one["name"]: 1e3 * one["stats"]["median"] for one in bench(file)}
    steps = {
        "step without the estimate": (ms["test_step[without]"], 40.0),
        "step with it": (ms["test_step[estimate]"], 40.0),
    }
    for n in (1, 2, 4):
        what = f"step of {n} environment{'s' * (n > 1)} in {n} process{'es' * (n > 1)} (`make_vec`), without it"
        steps[what] = ms[f"test_step_in_processes[{n}]"], 40.0 * n
    rows = [[what, f"{each:.1f} ms", f"{of / each:.1f}"] for what, (each, of) in steps.items()]
    reset = ["reset: plan, bring-up, approach, touch-down, settling", f"{ms['test_reset']:.0f} ms", ""]
    return {"command": f"{BENCH}{file}", "table": [["", "median", "× real time"], *rows, reset]}


def learning() -> Entry:
    """What the example of a policy learns."""
    command = "python -m canprobe.lab.examples.learn_touch_scan"
    return {
        "command": command,
        "findings": [line for line in printed(command).splitlines() if line.startswith(("train", "held_out"))],
    }


def bridges() -> Entry:
    """What bridges add to a cycle."""
    command = "python tests/support/bridges_bench.py"
    return {"command": command} | _found("bridges", json.loads(printed(f"{command} --json")))


def canopen_node() -> Entry:
    """What `canprobe conform` finds in CANopenNode's demo device; CANOPEN_NODE names the clones."""
    node, demo, _ = os.environ["CANOPEN_NODE"].split()
    entry = json.loads(printed(f"python tests/support/canopen_node.py {shlex.quote(node)} {shlex.quote(demo)}"))
    return {"command": "python tests/support/canopen_node.py CANopenNode CANopenDemo"} | entry


def canopen_node_vcan() -> Entry:
    """What it finds on a vcan0 in the same device for Linux, and in those with a defect."""
    script = "python tests/support/canopen_node_vcan.py"
    entry = json.loads(printed(f"{script} {shlex.join(os.environ['CANOPEN_NODE'].split())}"))
    return {"command": f"{script} CANopenNode CANopenDemo CANopenLinux"} | entry


def test_lines() -> Entry:
    """How long the README's lines of tests take, and what they end with."""
    entry: Entry = {"command": "python -m pytest && python -m pytest -m ''", "minutes": [], "findings": []}
    for line in entry["command"].split(" && "):
        begun_s = time.monotonic()
        entry["findings"].append(f"`{line}`: {printed(f'{line} -q').splitlines()[-1].strip('= ')}")
        entry["minutes"].append(round((time.monotonic() - begun_s) / 60.0, 1))
    return entry


def first_hour() -> Entry:
    """Times from a key of the console to frames and standstill, on a vcan0."""
    command = "canprobe vcan -- python -m pytest -n0 -s tests/vcan/test_first_hour.py -m ''"
    lines = printed(command).splitlines()
    return {"command": command, "findings": [line for line in lines if line.startswith("key to")]}


def hard_runs() -> Entry:
    """The runs that press hardest."""
    return {"command": "python docs/hard_cases.py", "table": hard_cases.table()}


def local_node() -> Entry:
    """What `canprobe conform` finds in canopen-python's LocalNode."""
    command = "python tests/support/local_node.py"
    return {"command": command} | json.loads(printed(command))


def shown(name: str) -> Entry:
    """What the last of some commands prints, without its files and its time on the wall, and the pictures of it."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        lines = printed_by(name)
    return {"command": " && ".join(shlex.join(["canprobe", *words]) for words in PRINTED[name]), "printed": lines}


def printed_by(name: str) -> list[str]:
    """The lines of `PRINTED`, by commands that run in the working folder and in this process."""
    from canprobe.cli import main as command

    for array in re.findall(r"```toml\n(\[array\].*?)```", (DOCS / "own-array.md").read_text(encoding="utf-8"), re.S)[
        :1
    ]:
        Path("small.toml").write_text(array, encoding="utf-8")
    said = io.StringIO()
    for words in PRINTED[name]:
        with contextlib.redirect_stdout(said := io.StringIO()):
            if status := command([word.replace("canprobe/", f"{DOCS.parent}/canprobe/") for word in words]):
                raise SystemExit(f"canprobe {shlex.join(words)}: ended with status {status}")
    lines = [
        line for line in said.getvalue().splitlines() if not line.startswith(("  files ", "next: ", "  expected "))
    ]
    return [re.sub(r" in [\d.]+ s \([\d.]+ × real time\)", "", line) for line in lines]


PRINTED: Mapping[str, Sequence[Sequence[str]]] = {
    "first_day": [["run", "cylinder", "--full", "--no-figures", "--out", "runs/first"]],
    "own_arm": [
        ["init", "my-cell", "--urdf", "canprobe/cells/prbt.urdf", "--eds", "canprobe/fieldbus/eds/prbt_joint.eds"],
        ["run", "my-cell/first.toml", "--no-figures"],
    ],
    "own_array": [["run", "cylinder", "--set", "sensor.array=small.toml", "--no-figures"]],
    "explored": [["run", "explore", "--bus", "direct", "--no-figures"]],
}
"""Commands of which a page shows what the last one prints."""


def pictures() -> Entry:
    """The pictures of the default scan, with the figures of `first_day`, and those of the gallery, drawn anew."""
    result = canprobe.run("cylinder", {"outputs.figures": False})
    draw_run(result, IMAGES / "cylinder.png")
    draw_surface(result, IMAGES / "surface.png")
    draw_moving(canprobe.run("cylinder", {"outputs.figures": False}, duration_s=5.0), IMAGES / "scan.webp")
    for name in ("cylinder", "surface"):
        path = IMAGES / f"{name}.png"
        Image.open(path).convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE).save(path, optimize=True)
    panels = [draw_panel(name).relative_to(IMAGES).as_posix() for name, _ in packaged("scene")]
    return drawn("pictures", OF_SCENES, panels)


def screens() -> Entry:
    """The pictures of reports, of the view and of the console."""
    draw_reports(IMAGES)
    draw_view(IMAGES / "view.png")
    from console_picture import draw_console  # imports the extra `console`

    asyncio.run(draw_console(IMAGES / "console.svg"))
    return drawn("screens", OF_SCREENS)


def drawn(entry: str, pictures: Iterable[str], panels: Iterable[str] = ()) -> Entry:
    """An entry of pictures: the code that has drawn them, and what it drew; panels are drawn by the code of one."""
    return {
        "command": f"python docs/measure.py {entry}",
        "drawn_by": {name: drawing_code(name) for name in pictures},
        "pictures": {name: picture_digest(name) for name in sorted({*pictures, *panels})},
    }


def picture_digest(name: str) -> str:
    """Digest of a picture of the pages: the entry that it was drawn with has it."""
    return hashlib.sha256((IMAGES / name).read_bytes()).hexdigest()[:16]


RESULTS = DOCS.parent / "canprobe" / "cell" / "results"
REPORTS = DOCS.parent / "canprobe" / "fieldbus" / "tools" / "reports"
OF_SCENES: Mapping[str, Sequence[Path]] = {
    "cylinder.png": [RESULTS / f"{name}.py" for name in ("figures", "picture", "surface_figure")],
    "surface.png": [RESULTS / f"{name}.py" for name in ("surface_figure", "picture")],
    "scan.webp": [DOCS / "moving_picture.py"],
    "scenes/cylinder.png": [DOCS / "gallery.py", *(RESULTS / f"{name}.py" for name in ("figures", "picture"))],
}
OF_SCREENS: Mapping[str, Sequence[Path]] = {
    **dict.fromkeys(
        ("conform.png", "judge.png"), (DOCS / "report_pictures.py", REPORTS / "page.py", REPORTS / "page.css")
    ),
    "view.png": [DOCS / "view_picture.py", *sorted((DOCS.parent / "bridge" / "view").glob("*.py"))],
    "console.svg": [DOCS / "console_picture.py", DOCS.parent / "canprobe" / "cli" / "console_screen.py"],
}
DRAWN_BY = {**OF_SCENES, **OF_SCREENS}
"""Code that draws a picture: where it changes, the picture is drawn anew, and with the one of a scene all of them."""


def drawing_code(name: str) -> str:
    """Digest of the code that draws a picture."""
    digest = hashlib.sha256()
    for module in DRAWN_BY[name]:
        text = module.read_text(encoding="utf-8")
        digest.update((ast.dump(ast.parse(text)) if module.suffix == ".py" else text).encode())
    return digest.hexdigest()[:16]


OTHERS: Mapping[str, Callable[[], Entry]] = {
    "local_node": local_node,
    "hard_cases": hard_runs,
    "first_hour": first_hour,
    "test_lines": test_lines,
    "canopen_node": canopen_node,
    "canopen_node_vcan": canopen_node_vcan,
    "one_scan": one_scan,
    "whole_cell": whole_cell,
    "vcan0": vcan0,
    "pace": partial(bench_table, "pace"),
    "side_by_side": partial(bench_table, "side_by_side"),
    "growth": partial(bench_table, "growth"),
    "held": partial(bench_table, "held"),
    "gym": gym,
    "learning": learning,
    "bridges": bridges,
    "pictures": pictures,
    "screens": screens,
    **{name: partial(shown, name) for name in PRINTED},
}


def main(wanted: Sequence[str]) -> None:
    """Measure what is named, or all; the rest keeps its figures. The file is written after each."""
    scenes = [name for name, _ in packaged("scene")]
    known = [*scenes, *OTHERS, *(name for name in STUDIES if name not in scenes), *FORMS]
    if unknown := set(wanted) - set(known):
        raise SystemExit(f"expected names among {', '.join(known)}; got {', '.join(sorted(unknown))}")
    for name in wanted or [name for name in known if name not in LONG]:
        print(name, flush=True)
        where = origin()
        entry = where | (scene(name) if name in scenes else OTHERS[name]() if name in OTHERS else study(name))
        measured = json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {"scenes": {}}
        (measured["scenes"] if name in scenes else measured)[name] = entry
        FILE.write_text(json.dumps(measured, indent=1, ensure_ascii=False, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
