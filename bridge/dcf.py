"""Device configuration files: the EDS of each node with the values that bring-up writes into it.

A configuration tool, or another master's boot slave, brings the nodes to the same state from them. Source: CiA 306-1,
"Device configuration file": `ParameterValue`, `[DeviceComissioning]` (spelt so there), `[<index>Value]`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.node_configuration import NodeConfiguration
from canprobe.fieldbus.bus.files import write_text
from canprobe.fieldbus.eds.findings import EdsFindings
from canprobe.fieldbus.eds.packaged import eds_file
from canprobe.fieldbus.eds.sections import LINE_END_PATTERN, Section, Sections, decode, split_sections

Values = Mapping[tuple[int, int], int]
"""Value by (index, sub-index)."""


def write_dcfs(plan: Plan, folder: Path) -> list[Path]:
    """Write ``node001.dcf`` and so on, one for each node of the plan.

    Args:
        plan: plan of the nodes.
        folder: existing folder.

    Returns:
        The files.
    """
    paths = []
    for setup in plan.nodes:
        path = folder / f"node{setup.node_id:03}.dcf"
        write_text(path, _dcf_of(plan, setup, path.name), newline="")
        paths.append(path)
    return paths


def final_values(setup: NodeConfiguration) -> dict[tuple[int, int], int]:
    """Value of each entry after bring-up; commands, which keep no value, are left out."""
    return {(write.index, write.subindex): write.value for write in setup.writes if write.read_back}


def _dcf_of(plan: Plan, setup: NodeConfiguration, name: str) -> str:
    source = eds_file(setup.eds)
    commissioning = {
        "NodeID": str(setup.node_id),
        "NodeName": setup.name,
        "Baudrate": str(plan.scene.bus.bitrate // 1000),
        "NetNumber": "1",
        "NetworkName": setup.channel,
        "CANopenManager": "0",
    }
    keys = {"fileinfo": {"FileName": name, "LastEDS": source.name}, "devicecomissioning": commissioning}
    return dcf_text(decode(source.read_bytes(), EdsFindings()), final_values(setup), keys)


def dcf_text(eds: str, values: Values, keys: Mapping[str, Mapping[str, str]]) -> str:
    """An EDS text with values and keys put in; every other line stays as it is.

    Args:
        eds: text of the file.
        values: `ParameterValue` of each entry.
        keys: other keys by section in lower case; a section that is not there is added.
    """
    lines = LINE_END_PATTERN.split(eds.rstrip())
    sections = split_sections(eds, EdsFindings())
    wanted: dict[str, dict[str, str]] = {name: dict(items) for name, items in keys.items()}
    for (index, subindex), value in values.items():
        section, key = _place(sections, index, subindex)
        wanted.setdefault(section, {})[key] = _number(value)
    added = [line for name, items in wanted.items() if name not in sections for line in _new_section(name, items)]
    present = [name for name in wanted if name in sections]
    for name in sorted(present, key=lambda name: sections[name].line, reverse=True):  # from the end: lines keep theirs
        _edit(lines, sections[name], wanted[name])
    return "\n".join([*lines, *added]) + "\n"


def _place(sections: Sections, index: int, subindex: int) -> tuple[str, str]:
    """Section and key of a value; that of a sub-index which the file lists nowhere stands in [indexValue]."""
    member = f"{index:x}sub{subindex:x}"
    if member in sections:
        return member, "ParameterValue"
    if subindex == 0 and not sections.get(f"{index:x}", Section("", 0)).value("SubNumber"):
        return f"{index:x}", "ParameterValue"
    return f"{index:x}value", str(subindex)


def _edit(lines: list[str], section: Section, items: Mapping[str, str]) -> None:
    last = max((item.line for item in section.items.values()), default=section.line)
    new = []
    for key, value in items.items():
        if (old := section.items.get(key.lower())) is not None:
            lines[old.line - 1] = f"{old.key}={value}"
        else:
            new.append(f"{key}={value}")
    lines[last:last] = new


def _new_section(name: str, items: Mapping[str, str]) -> list[str]:
    if name == "devicecomissioning":
        return ["", "[DeviceComissioning]", *(f"{key}={value}" for key, value in items.items())]
    head = f"{name.removesuffix('value').upper()}{'Value' if name.endswith('value') else ''}"
    count = [f"NrOfEntries={len(items)}"] if name.endswith("value") else []
    return ["", f"[{head}]", *count, *(f"{key}={value}" for key, value in items.items())]


def _number(value: int) -> str:
    return f"0x{value:X}" if value > 9 else str(value)
