"""DCF files and bus.yml, read back by canopen and by Lely's dcf-tools."""

import struct
import subprocess
import sys

import canopen
import pytest
import yaml

import canprobe
from canprobe.cli import main
from canprobe.errors import UsageError
from canprobe.fieldbus.eds.packaged import check_eds
from canprobe.lab.bridge.bus_yml import read_bus_yml, write_bus_yml
from canprobe.lab.bridge.dcf import dcf_text, final_values, write_dcfs


@pytest.fixture(scope="module", params=["press", "free"])
def plan(request):
    return canprobe.plan(request.param, {"arm.grouped_rpdo": request.param == "free"})


def entry(od, index, subindex):
    found = od[index]
    return found[subindex] if hasattr(found, "subindices") else found


def test_canopen_reads_back_every_value_that_bring_up_writes(plan, tmp_path):
    for setup, path in zip(plan.nodes, write_dcfs(plan, tmp_path), strict=True):
        assert not check_eds(path).faults
        od = canopen.import_od(str(path))
        assert (od.node_id, od.bitrate) == (setup.node_id, 1_000_000)
        values = final_values(setup)
        assert len(values) > 20
        assert {key: entry(od, *key).value for key in values} == values


def test_dcf_tools_find_no_fault(plan, tmp_path):
    *_, path = write_dcfs(plan, tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from dcf.cli import main; sys.exit(main())", path],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_values_without_a_section_go_where_the_compact_form_has_them():
    eds = "[1016]\nParameterName=Consumer\nObjectType=0x8\nDataType=0x7\nCompactSubObj=3\n\n[1017]\nDefaultValue=0\n"
    text = dcf_text(eds, {(0x1016, 2): 0x7F00FA, (0x1017, 0): 100}, {})
    assert text.endswith("[1017]\nDefaultValue=0\nParameterValue=0x64\n\n[1016Value]\nNrOfEntries=1\n2=0x7F00FA\n")


def test_dcfgen_makes_the_masters_files_of_bus_yml_with_the_same_writes(plan, tmp_path):
    """The concise writes that Lely's own generator makes bring every entry to the value that our bring-up gives it."""
    write_bus_yml(plan, tmp_path)
    kept = (plan.nodes[0], plan.nodes[-1])  # it reads every EDS anew, a second each
    document = yaml.safe_load((tmp_path / "bus.yml").read_text())
    for node in set(plan.nodes) - set(kept):
        del document[node.name.replace(" ", "_")]
    (tmp_path / "bus.yml").write_text(yaml.safe_dump(document))
    (tmp_path / "out").mkdir()
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", "from dcfgen.cli import main; main()", "-d", "out", "-r", "bus.yml"],
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    for setup in (setup for setup in plan.nodes if setup.node_id in {node.node_id for node in kept}):
        written = concise((tmp_path / "out" / f"{setup.name.replace(' ', '_')}.bin").read_bytes())
        od = setup.dictionary
        for (index, subindex), value in final_values(setup).items():
            variable = entry(od, index, subindex)
            got = written.get((index, subindex), None)
            if got is None or index == 0x1016:  # dcfgen leaves out what the EDS has already; it consumes by itself
                assert index == 0x1016 or variable.default == value, (setup.node_id, hex(index), subindex)
            elif not (value & 1 << 31 and subindex == 1):  # switched off: the identifier behind the bit is free
                assert variable.decode_raw(got) == value, (setup.node_id, hex(index), subindex)
            else:
                assert variable.decode_raw(got) & 1 << 31


def concise(data):
    """Entries of a concise DCF, the last write of each. Source: CiA 302-3."""
    (count,), offset, found = struct.unpack_from("<I", data), 4, {}
    for _ in range(count):
        index, subindex, length = struct.unpack_from("<HBI", data, offset)
        found[index, subindex] = data[offset + 7 : offset + 7 + length]
        offset += 7 + length
    assert offset == len(data)
    return found


def test_each_of_two_buses_has_its_own_bus_yml(tmp_path):
    plan = canprobe.plan("press", {"sensor.channel": "can1"})
    names = [path.name for path in write_bus_yml(plan, tmp_path) if path.suffix == ".yml"]
    assert names == ["bus-can0.yml", "bus-can1.yml"]
    found = [[node.node_id for node in read_bus_yml(tmp_path / name)] for name in names]
    assert found == [[1, 2, 3, 4, 5, 6], [16]]
    write_dcfs(plan, tmp_path)
    assert "NetworkName=can1" in (tmp_path / "node016.dcf").read_text()


def test_bus_yml_comes_back(plan, tmp_path):
    write_bus_yml(plan, tmp_path)
    found = read_bus_yml(tmp_path / "bus.yml")
    assert [(node.name.replace("_", " "), node.node_id) for node in found] == [
        (node.name, node.node_id) for node in plan.nodes
    ]
    assert {node.eds.parent for node in found} == {tmp_path}


OF_TODAY = """\
options: {dcf_path: "@BUS_CONFIG_PATH@/files"}
master: {node_id: 1, driver: "ros2_canopen::MasterDriver", package: canopen_master_driver, sync_period: 10000}
defaults: {dcf: "drive.eds", driver: "ros2_canopen::Cia402Driver", package: canopen_402_driver, perod: 10}
nodes:
  axis_2: {node_id: 0x3, dcf: "@BUS_CONFIG_PATH@/files/more/drive.eds"}
  axis_1: {node_id: 2, diagnostics: {enable: true, period: 1000}}
  axis_3: {node_id: 4, eds: drive.eds, dcf_path: "/elsewhere/install/share", channels: &two {1: {joint_name: a}}}
  axis_4: {dcf: made.dcf, dcf_path: ".", channels: *two, remappings: {~/nmt_state: /state}}
boot_timeout: 3000
"""


def test_slaves_under_nodes_with_common_keys_and_folders_are_read(tmp_path):
    """The third folder is that of another machine, the fourth has its id from the DCF; an anchor is no key twice."""
    (tmp_path / "files" / "more").mkdir(parents=True)
    for place in ("files/drive.eds", "files/more/drive.eds", "drive.eds"):
        (tmp_path / place).write_text("[FileInfo]\n")
    (tmp_path / "made.dcf").write_text("[DeviceComissioning]\nNodeID=5\n")
    (tmp_path / "bus.yml").write_text(OF_TODAY)
    said = []
    found = read_bus_yml(tmp_path / "bus.yml", said.append)
    assert [(node.name, node.node_id, str(node.eds.resolve().relative_to(tmp_path.resolve()))) for node in found] == [
        ("axis_1", 2, "files/drive.eds"),
        ("axis_2", 3, "files/more/drive.eds"),
        ("axis_3", 4, "drive.eds"),
        ("axis_4", 5, "made.dcf"),
    ]
    assert [line.partition(": ")[2] for line in said] == [
        "boot_timeout: not understood, passed over",
        "defaults: perod: not understood, passed over; did you mean period?",
    ]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("- 1", "expected the nodes of a bus by name, got list"),
        ("a: {", "no YAML"),
        ("master: {node_id: 1}", "no node under nodes, and none besides"),
        (
            "nodes: {a: {node_id: 2, dcf: x.eds}}\na: {node_id: 3, dcf: x.eds}",
            "a: stands under nodes and beside master",
        ),
        ("nodes: [a]", "nodes: expected keys and values"),
        ("nodes: {a: {dcf: x.eds}}", "a: node_id: expected an integer, got None"),
        ("a: 3", "a: expected keys and values"),
        ("nodes:\n  a: {node_id: 2, dcf: x.eds}\n  a: {node_id: 3, dcf: x.eds}", r"bus\.yml:3: a: stands twice"),
        ("a: {node_id: 2, node_id: 3, dcf: x.eds}", r"bus\.yml:1: node_id: stands twice"),
        ("a: {node_id: 200, dcf: x.eds}", "a: node_id: expected 1 to 127, got 200"),
        ("a: {node_id: two, dcf: x.eds}", "a: node_id: expected an integer, got 'two'"),
        ("a: {node_id: .inf, dcf: x.eds}", "a: node_id: expected an integer, got inf"),
        ("a: {node_id: 2}", "a: dcf: expected the name"),
        ("a: {node_id: 2, dcf: y.eds}", "a: dcf: no file y.eds"),
        ("a: {node_id: 2, dcf: x.eds}\nb: {node_id: 2, dcf: x.eds}", "b: node_id: 2 is that of a too"),
    ],
)
def test_what_is_wrong_in_a_bus_yml_is_said(tmp_path, text, complaint):
    (tmp_path / "x.eds").write_text("")
    (tmp_path / "bus.yml").write_text(text)
    with pytest.raises(UsageError, match=complaint):
        read_bus_yml(tmp_path / "bus.yml")


def test_the_command_writes_every_format(tmp_path, capsys):
    formats = [word for form in ("dcf", "dbc", "kcd", "bus.yml") for word in ("--export", form)]
    assert main(["plan", "free", *formats, "--out", str(tmp_path / "new")]) == 0
    files = capsys.readouterr().out.split()
    assert {path.name for path in (tmp_path / "new").iterdir()} == {file.rpartition("/")[2] for file in files}
    assert len(files) == 6 + 1 + 1 + 2
