"""One version in all places, and files of other versions: docs/versions.md says what is promised, and it is true."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

import canprobe
from canprobe.cell.master import node_record
from canprobe.cell.planning import report
from canprobe.cell.recorded import reestimate
from canprobe.cell.results import run_files, surface_file
from canprobe.cell.scene import calibrations
from canprobe.cell.scene.load import load_cell, load_scene, packaged_files, scenes_folder
from canprobe.errors import SceneError, UsageError
from canprobe.fieldbus.drive.from_eds import make_eds_node
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.node import stored_file
from canprobe.fieldbus.tools.conform import journal
from canprobe.fieldbus.tools.reports import Report, json_file, read_json, write_json

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "versions.md").read_text(encoding="utf-8")


def test_the_version_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (.*)$", citation, re.M)[1] == project["version"] == canprobe.__version__
    wheels = re.findall(r"canprobe-([\d.]+)-py3", PAGE)
    assert set(wheels) == {canprobe.__version__}


def test_the_page_has_the_schemas_of_the_code():
    rows = re.findall(r"^\| ([^|]+) \|.*\| ([^|]+) \|$", PAGE[PAGE.index("| file |") :], re.M)
    stated = {name: schema for name, schema in rows if schema[0].isdigit()}
    assert stated == {
        "calibration of an array (`*.toml`)": str(calibrations.SCHEMA),
        "`summary.json`": f"{run_files.SCHEMA}; of `replay` {reestimate.SCHEMA}",
        "`surface.npz`": str(surface_file.FORMAT_VERSION),
        "plan (`plan --json`)": str(report.SCHEMA),
        "report of an examination (`*.json`)": str(json_file.SCHEMA),
        "snapshot of a device (`*.snapshot.json`)": str(journal.SCHEMA),
        "zeros of a cell (`zeros-CELL.json`)": str(node_record.SCHEMA),
        "commissioning record of a cell (`joints-CELL.json`)": str(node_record.SCHEMA),
        "stored parameters of an emulated node (`node*.json`)": str(stored_file.SCHEMA),
    }


def raise_schema(path, key="schema"):
    document = json.loads(path.read_text())
    assert document[key] == 1
    path.write_text(json.dumps({**document, key: 2}))


def newer_summary(folder):
    (folder / "summary.json").write_text(json.dumps({"schema": run_files.SCHEMA + 1, "written_by": "canprobe 9.0.0"}))
    run_files.read_summary(folder)


def newer_report(folder):
    write_json(Report("conform", "a device"), folder / "report.json")
    raise_schema(folder / "report.json")
    read_json(folder / "report.json")


def newer_node(folder):
    def node():
        made = make_eds_node(load_eds("puma260_joint", 1), 1)
        stored_file.keep_in_file(made, folder / "node001.json")
        made.start(0)
        return made

    node().receive(0x601, bytes.fromhex("2310100173617665"), 0)  # 1010h:01 = "save"
    node()  # its own is read
    raise_schema(folder / "node001.json")
    node()


def newer_zeros(folder):
    path = folder / "zeros-x.json"
    node_record.NodeRecord(path, "").put(1, {"zero": 3})
    assert node_record.NodeRecord(path, "").entry(1) == {"zero": 3}
    path.write_text('{"nodes": {"1": {"zero": 4}}}')
    assert node_record.NodeRecord(path, "").entry(1) == {"zero": 4}, "as 0.1 wrote it"
    node_record.NodeRecord(path, "").put(1, {"zero": 3})
    raise_schema(path)
    node_record.NodeRecord(path, "")


def newer_snapshot(folder):
    path = folder / "device.snapshot.json"
    journal.Journal({(0x1017, 0): b"\0\0"}, path, "a device").note((0x1017, 0))
    assert journal.Journal.load(path).values == {(0x1017, 0): b"\0\0"}
    raise_schema(path)
    journal.Journal.load(path)


@pytest.mark.parametrize("read", [newer_summary, newer_report, newer_node, newer_zeros, newer_snapshot])
def test_a_file_of_a_newer_version_says_so(tmp_path, read):
    with pytest.raises(
        UsageError, match=r"\.json.*: the file is of a newer canprobe: .* up to schema (1, got 2|2, got 3); .*canprobe"
    ):
        read(tmp_path)


def test_a_newer_surface_map_and_calibration_say_so(tmp_path):
    columns = {"format_version": np.array(9), "method": np.array("ml")}
    np.savez(tmp_path / "surface.npz", **columns)
    with pytest.raises(UsageError, match=r"surface.npz: expected format_version \d+, got 9"):
        canprobe.load_surface_map(tmp_path)
    text = packaged_files("calibrations")["inch16"].read_text()
    text = re.sub(r"(?m)^schema = 1$", "schema = 2", re.sub(r"(?m)^written_by.*\n", "", text))
    (tmp_path / "pad.toml").write_text(f'written_by = "canprobe 9.0.0"\n{text}')
    with pytest.raises(
        SceneError, match=r"written by canprobe 9.0.0, this is .*: calibration.schema: expected .*, got 2"
    ):
        calibrations.load_calibration(tmp_path / "pad.toml")


def test_a_scene_or_cell_with_keys_of_a_newer_version_names_it(tmp_path):
    scene = (scenes_folder() / "free.toml").read_text()
    (tmp_path / "free.toml").write_text(f'written_by = "canprobe 9.0.0"\n{scene}\n[bus]\nwarp = 9\n')
    with pytest.raises(SceneError, match=r"written by canprobe 9.0.0, this is canprobe .*: bus.warp: unknown key"):
        load_scene(tmp_path / "free.toml")
    cell = packaged_files("cells")["puma260"].read_text().replace("[probe]", "[probe]\nwarp = 9")
    (tmp_path / "cell.toml").write_text(f'written_by = "canprobe 9.0.0"\n{cell}')
    with pytest.raises(SceneError, match=r"written by canprobe 9.0.0, this is canprobe .*: probe.warp: unknown key"):
        load_cell(tmp_path / "cell.toml")
