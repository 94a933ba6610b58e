"""CANopenNode's demo device for Linux on a real vcan0, as it is and with seven defects: what `conform` finds in each.

And what `judge` finds there in `small_master.py`.

`python tests/support/canopen_node_vcan.py NODE DEMO LINUX` prints it as docs/measure.py wants it; the three are clones
of github.com/CANopenNode/CANopenNode, /CANopenDemo and /CANopenLinux. canprobe is installed beside python-can and
canopen alone, in an environment of its own. It needs gcc, make and what `canprobe vcan` needs.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

from canopen_node import NODE_ID, PERMITTED, commit_of

ROOT = Path(__file__).resolve().parents[2]
MASTER = Path(__file__).with_name("small_master.py")
DEFECTS = {
    "toggle": ("SDOserver", "if (toggle != SDO->toggle)", "if (0)"),
    "heartbeat": ("NMT_Heartbeat", "CO_getUint16(buf) * 1000U", "CO_getUint16(buf) * 1200U"),
    "EMCY": ("Emergency", ".msg |= (uint32_t)errorRegister << 16", ".msg |= 0"),
    "inhibit time": ("PDO", "TPDO->inhibitTimer = TPDO->inhibitTime_us", "TPDO->inhibitTimer = 0"),
    "consumer": ("HBconsumer", "Timer >= monitoredNode->time_us", "Timer >= 2 * monitoredNode->time_us"),
    "abort": ("ODinterface", "0x06020000UL", "0x06090011UL"),
    "short TPDO 2": ("PDO", "CAN_ID, false, PDO->dataLength,", "CAN_ID, false, PDO->dataLength - (CAN_ID >> 7 == 5),"),
}
"""A file of its folder 301, what stands there, and what stands there instead."""
EXAMINE = f"""
"$CANPROBE" judge --eds puma260_joint --node-id 5 --channel vcan0 --passive --without 32,33,34,45 --json \\
    -- "$(dirname "$CANPROBE")/python" "$MASTER" 5 socketcan vcan0 >judged.json
for device in */demo; do
    cd "$device"
    for name in od_comm mainline od_app od_app_auto; do echo - >$name.persist; done # empty memory, not faulty memory
    ./demoLinuxDevice vcan0 -i {NODE_ID} 2>log &
    until grep -q running log; do sleep 0.1; done
    "$CANPROBE" conform --node {NODE_ID} --eds demoDevice.eds --channel vcan0 --write {PERMITTED} --json >report.json
    kill %% && wait
    cd ../..
done
"""


def build(node: Path, demo: Path, linux: Path, folder: Path, change: tuple[str, str, str] | None) -> None:
    """Compile the device by its own Makefile, with one text of its source changed."""
    for source, place in ((linux, "CANopenLinux"), (node, "CANopenLinux/CANopenNode"), (demo / "demo", "demo")):
        shutil.copytree(source, folder / place, dirs_exist_ok=True, ignore=shutil.ignore_patterns(".*"))
    if change is not None:
        file, old, new = change
        path = folder / "CANopenLinux" / "CANopenNode" / "301" / f"CO_{file}.c"
        text = path.read_text(encoding="utf-8")
        assert old in text, f"{path}: expected {old}"
        path.write_text(text.replace(old, new), encoding="utf-8")
    words = ["make", "-s", "-j2", "OPT=-w -DCO_SINGLE_THREAD", f"GIT_VERSION={commit_of(demo)}"]
    subprocess.run(words, cwd=folder / "demo", check=True, stdout=sys.stderr)


def install(folder: Path) -> Path:
    """Program of canprobe in an environment with python-can and canopen alone."""
    venv.create(folder, with_pip=True)
    for words in (["python-can", "canopen"], ["--no-deps", ROOT]):
        subprocess.run([folder / "bin" / "pip", "install", "-q", *words], check=True, stdout=sys.stderr)
    assert not [*folder.glob("lib/*/site-packages/numpy")], "python-can and canopen bring numpy"
    return folder / "bin" / "canprobe"


def failed(path: Path) -> dict[str, str]:
    """Points or rules that failed in a report, with what was wrong."""
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
    return {f"{row['group']} {row['name']}": row["detail"] for row in rows if row["verdict"] in ("FAIL", "ERROR")}


def main(node: Path, demo: Path, linux: Path) -> None:
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        canprobe = install(folder / "environment")
        for name, change in {"as it is": None, **DEFECTS}.items():
            build(node, demo, linux, folder / name, change)
        words = [
            canprobe,
            "vcan",
            "--",
            "env",
            "-u",
            "PYTHONPATH",
            f"CANPROBE={canprobe}",
            f"MASTER={MASTER}",
            "bash",
            "-c",
            EXAMINE,
        ]
        subprocess.run(words, cwd=folder, check=True)
        raised = failed(folder / "judged.json")
        found = {name: failed(folder / name / "demo" / "report.json") for name in ("as it is", *DEFECTS)}
    usual = found.pop("as it is")
    table = [["defect", "point", "what it does"]]
    for name, points in found.items():
        table += [[name, point, detail] for point, detail in points.items() if point not in usual] or [[name, "", ""]]
    places = f"CANopenNode {commit_of(node)}, CANopenDemo {commit_of(demo)}, CANopenLinux {commit_of(linux)}"
    number = sum(not points.keys() <= usual.keys() for points in found.values())
    ends = [f"{number} of {len(found)} defects found", f"as it is: FAIL of {', '.join(usual)}"]
    ends.append(f"`judge` of {MASTER.name}: {', '.join(raised)}")
    print(json.dumps({"table": table, "findings": [f"{places}, --write {PERMITTED}", *ends]}))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
