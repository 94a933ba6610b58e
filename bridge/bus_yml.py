"""ros2_canopen's `bus.yml`: writes a plan as one, and reads the nodes of one.

The file's keys are those of Lely's dcfgen, which makes the master's configuration of it; ros2_canopen adds those of
its drivers, and `defaults` and `nodes`: the slaves stand under `nodes`, where dcfgen has them beside `master`. dcfgen
maps neither dummies nor PDOs of CAN FD: such a PDO is written by `sdo` entries, in the order of bring-up, and the
master's side of it has to be configured by hand. Source: ros2_canopen manual, "Bus configuration file"; lely-core's
dcfgen.
"""

from __future__ import annotations

import itertools
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from canprobe.cell.planning.configuration import SYNC_START_VALUE
from canprobe.cell.planning.device_capabilities import MAPPING
from canprobe.cell.planning.model import HEARTBEAT_CONSUMED_MS, HEARTBEAT_PRODUCED_MS, MASTER_NODE_ID, Plan, PlannedPdo
from canprobe.cell.planning.node_configuration import Direction, NodeConfiguration, Write
from canprobe.cell.scene.toml_files import MAX_BYTES
from canprobe.errors import UsageError, did_you_mean, needed_module, regular_file
from canprobe.fieldbus.bus.files import whole_file, write_text
from canprobe.fieldbus.eds.device_info import commissioned_node
from canprobe.fieldbus.eds.findings import EdsFindings
from canprobe.fieldbus.eds.packaged import eds_file
from canprobe.fieldbus.eds.sections import decode, split_sections
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES, INVALID_FLAG
from canprobe.fieldbus.protocol.pdo import PDO_OBJECTS

_NEED = "a bus.yml needs yaml; type:"
_DRIVERS = {
    "drive": ("ros2_canopen::Cia402Driver", "canopen_402_driver"),
    "tactile": ("ros2_canopen::ProxyDriver", "canopen_proxy_driver"),
}
_NOT_SLAVES = ("options", "master", "defaults", "nodes")
_SLAVE_KEYS = frozenset({
    # of dcfgen
    "node_id", "dcf", "dcf_path", "revision_number", "serial_number", "heartbeat_multiplier", "heartbeat_consumer",
    "heartbeat_producer", "time_cob_id", "retry_factor", "guard_time", "life_time_factor", "error_behavior", "rpdo",
    "tpdo", "boot", "mandatory", "reset_communication", "software_file", "software_version", "configuration_file",
    "restore_configuration", "sdo",
    # of the drivers
    "driver", "package", "namespace", "enable_lazy_load", "polling", "period", "diagnostics", "sdo_timeout_ms",
    "switching_state", "position_mode", "velocity_mode", "torque_mode", "scale_pos_to_dev", "scale_pos_from_dev",
    "scale_vel_to_dev", "scale_vel_from_dev", "scale_eff_to_dev", "scale_eff_from_dev", "offset_pos_to_dev",
    "offset_pos_from_dev", "homing_timeout_seconds", "num_channels", "joint_name", "vendor_id", "product_code",
    "boot_timeout", "boot_timeout_ms", "channels", "channel_names", "effort_mode", "non_transmit_timeout", "remappings",
    "eds",  # where dcfgen has dcf
})  # fmt: skip
_EDS_KEYS = ("dcf", "eds")
_OPTION_KEYS = frozenset(("dcf_path", "heartbeat_multiplier"))
_FOLDER_VARIABLE = "@BUS_CONFIG_PATH@"
_OWN_KEYS = (0x1016, 0x1017)  # dcfgen writes them from heartbeat_producer and heartbeat_consumer


@dataclass(frozen=True, slots=True)
class ListedNode:
    """A slave of a bus.yml.

    Attributes:
        name: its key.
        node_id: node id, 1–127.
        eds: its EDS or DCF file, found beside the bus.yml where the path is relative.
    """

    name: str
    node_id: int
    eds: Path


def write_bus_yml(plan: Plan, folder: Path) -> list[Path]:
    """Write ``bus.yml``, or for several buses ``bus-can0.yml`` and so on, and the EDS files that they name.

    Args:
        plan: plan of the nodes.
        folder: existing folder.

    Returns:
        The files.

    Raises:
        UsageError: PyYAML is not installed.
    """
    yaml = needed_module("yaml", "can", _NEED)
    files = {node.eds: folder / eds_file(node.eds).name for node in plan.nodes}
    for eds, path in files.items():
        if not path.exists() or not path.samefile(eds_file(eds)):
            with whole_file(path) as part:
                part.write_bytes(eds_file(eds).read_bytes())
    paths = []
    for bus in plan.buses:
        document: dict[str, Any] = {"options": {"dcf_path": "."}, "master": _master(plan)}
        for node in plan.nodes:
            if node.channel == bus.channel:
                document[node.name.replace(" ", "_")] = _slave(plan, node, files[node.eds].name)
        name = "" if len(plan.buses) == 1 else f"-{re.sub(r'[^A-Za-z0-9_.-]', '_', bus.channel)}"
        paths.append(folder / f"bus{name}.yml")
        write_text(paths[-1], _dump(yaml, document))
    return [*paths, *files.values()]


class _Hex(int):
    """An integer to write in hexadecimal."""


def _dump(yaml: Any, document: Mapping[str, Any]) -> str:
    class Dumper(yaml.SafeDumper):  # type: ignore[misc]
        """PyYAML's dumper with hexadecimal numbers and without anchors."""

        def ignore_aliases(self, data: object) -> bool:
            return True

    Dumper.add_representer(_Hex, lambda dumper, value: dumper.represent_scalar("tag:yaml.org,2002:int", f"0x{value:X}"))
    text: str = yaml.dump(document, Dumper=Dumper, sort_keys=False, default_flow_style=None, width=120)
    return text


def _master(plan: Plan) -> dict[str, Any]:
    return {
        "node_id": MASTER_NODE_ID,
        "driver": "ros2_canopen::MasterDriver",
        "package": "canopen_master_driver",
        "baudrate": plan.scene.bus.bitrate // 1000,
        "sync_period": plan.sync.period_us,
        "sync_overflow": plan.sync.overflow,
        "heartbeat_producer": HEARTBEAT_PRODUCED_MS,
        "heartbeat_multiplier": HEARTBEAT_CONSUMED_MS / HEARTBEAT_PRODUCED_MS,
    }


def _slave(plan: Plan, node: NodeConfiguration, eds: str) -> dict[str, Any]:
    driver, package = _DRIVERS[node.kind]
    revision = node.identity.revision_number
    return {
        "node_id": node.node_id,
        "dcf": eds,
        "driver": driver,
        "package": package,
        **({"revision_number": revision} if revision is not None else {}),
        "heartbeat_producer": HEARTBEAT_PRODUCED_MS,
        "heartbeat_consumer": True,
        "rpdo": _pdos(plan, node, "rpdo"),
        "tpdo": _pdos(plan, node, "tpdo"),
        "sdo": [
            {"index": _Hex(write.index), "sub_index": write.subindex, "value": int(write.value)}
            for write in node.writes
            if _by_sdo(plan, node, write)
        ],
    }


def _by_sdo(plan: Plan, node: NodeConfiguration, write: Write) -> bool:
    """Whether dcfgen has no key that makes this write."""
    if write.index not in PDO_OBJECTS:
        return write.index not in _OWN_KEYS
    direction: Direction = "rpdo" if write.index < 0x1800 else "tpdo"
    pdos = {pdo.number: pdo for pdo in plan.pdos_of(node.node_id, direction)}
    pdo = pdos.get((write.index & 0x1FF) + 1)
    return pdo is not None and (_by_hand(pdo) or (direction == "rpdo" and write.index < 0x1600 and write.subindex == 5))


def _by_hand(pdo: PlannedPdo) -> bool:
    """Whether dcfgen cannot map it: dummies, and what is longer than a classical frame."""
    return pdo.layout.length > CLASSIC_BYTES or any(entry.is_dummy for entry in pdo.entries)


def _pdos(plan: Plan, node: NodeConfiguration, direction: Direction) -> dict[int, Any]:
    off = {n: {"enabled": False, "cob_id": _Hex(INVALID_FLAG)} for way, n in node.switched_off if way == direction}
    written = {write.index for write in node.writes}
    on = {pdo.number: _pdo(pdo, written) for pdo in plan.pdos_of(node.node_id, direction) if not _by_hand(pdo)}
    return dict(sorted((off | on).items()))


def _pdo(pdo: PlannedPdo, written: set[int]) -> dict[str, Any]:
    found: dict[str, Any] = {"enabled": True, "cob_id": _Hex(pdo.cob_id), "transmission": pdo.transmission_type}
    if pdo.direction == "tpdo" and pdo.transmission_type > 1 and pdo.layout.synchronous:
        found["sync_start"] = SYNC_START_VALUE
    if MAPPING[pdo.direction] + pdo.number - 1 in written:  # a fixed mapping cannot be written
        found["mapping"] = [{"index": _Hex(entry.index), "sub_index": entry.subindex} for entry in pdo.entries]
    return found


def read_bus_yml(path: Path | str, say: Callable[[str], None] = lambda _: None) -> list[ListedNode]:
    """Read the nodes of a bus.yml, whether they stand under `nodes` or beside `master`.

    Args:
        path: path of the file; ``@BUS_CONFIG_PATH@`` is its folder. `dcf` paths are looked up in `dcf_path`, then
            beside the file, and at last there by their names alone, as folders may be those of another machine.
        say: function that reports each key that is not understood and passed over.

    Returns:
        The slaves by rising node id.

    Raises:
        UsageError: PyYAML is missing, or the file is no bus.yml; with the node and the key.
    """
    yaml = needed_module("yaml", "can", _NEED)
    path = Path(path)
    try:
        text = regular_file(path, MAX_BYTES).read_text(encoding="utf-8")
        document = yaml.load(text, _loader(yaml, path))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise UsageError(f"{path}: no YAML: {' '.join(str(error).split())}") from error
    if not isinstance(document, Mapping):
        raise UsageError(f"{path}: expected the nodes of a bus by name, got {type(document).__name__}")
    options, defaults, under = (_mapping(path, document, key) for key in ("options", "defaults", "nodes"))
    beside = {str(name): keys for name, keys in document.items() if name not in _NOT_SLAVES}
    if under:  # then beside them stands a node only where it says so
        for name in [name for name, keys in beside.items() if not isinstance(keys, Mapping) or "node_id" not in keys]:
            say(f"{path}: {name}: not understood, passed over")
            del beside[name]
    slaves = {**beside, **{str(name): keys for name, keys in under.items()}}
    if both := sorted(beside.keys() & set(map(str, under))):
        raise UsageError(f"{path}: {both[0]}: stands under nodes and beside master; remove one of them")
    _name_unknown(path, "options", options, _OPTION_KEYS, say)
    _name_unknown(path, "defaults", defaults, _SLAVE_KEYS, say)
    nodes = []
    for name in slaves:
        keys = _mapping(path, slaves, name)
        _name_unknown(path, name, keys, _SLAVE_KEYS, say)
        nodes.append(_read_node(path, name, {**defaults, **keys}, options))
    if not nodes:
        raise UsageError(f"{path}: no node under nodes, and none besides {', '.join(_NOT_SLAVES)}")
    nodes.sort(key=lambda node: node.node_id)  # of two with the same node id the first stays first
    for node, following in itertools.pairwise(nodes):
        if node.node_id == following.node_id:
            raise UsageError(f"{path}: {following.name}: node_id: {node.node_id} is that of {node.name} too")
    return nodes


def _loader(yaml: Any, path: Path) -> type:
    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        """PyYAML's loader that refuses a key that stands twice: of two nodes of one name only the last would count."""

        def compose_mapping_node(self, anchor: str | None) -> Any:
            node, known = super().compose_mapping_node(anchor), set[str]()
            for key in [key for key, _ in node.value if isinstance(key.value, str)]:
                if key.value in known:
                    raise UsageError(f"{path}:{key.start_mark.line + 1}: {key.value}: stands twice; remove one of them")
                known.add(key.value)
            return node

    return Loader


def _mapping(path: Path, document: Mapping[Any, Any], name: str) -> Mapping[str, Any]:
    found = document.get(name)
    if found is None:
        return {}
    if not isinstance(found, Mapping):
        raise UsageError(f"{path}: {name}: expected keys and values, got {found!r}")
    return found


def _name_unknown(
    path: Path, name: str, keys: Mapping[str, Any], known: frozenset[str], say: Callable[[str], None]
) -> None:
    for key in keys:
        if key not in known:
            say(f"{path}: {name}: {key}: not understood, passed over{did_you_mean(str(key), known, 0.6)}")


def _read_node(path: Path, name: str, keys: Mapping[str, Any], options: Mapping[str, Any]) -> ListedNode:
    key = next((key for key in _EDS_KEYS if key in keys), _EDS_KEYS[0])
    dcf = keys.get(key)
    if not isinstance(dcf, str) or not dcf:
        raise UsageError(f"{path}: {name}: {key}: expected the name of an EDS or DCF file, got {dcf!r}")
    eds = _find(path, dcf, str(keys.get("dcf_path", options.get("dcf_path", "."))))
    if eds is None:
        raise UsageError(f"{path}: {name}: {key}: no file {dcf} beside the bus.yml, nor in its dcf_path")
    stated: Any = keys.get("node_id")
    if stated is None:  # that of the DCF
        stated = commissioned_node(split_sections(decode(eds.read_bytes(), EdsFindings()), EdsFindings()))
    try:
        node_id = int(stated, 0) if isinstance(stated, str) else operator.index(stated)
    except (TypeError, ValueError):
        raise UsageError(f"{path}: {name}: node_id: expected an integer, got {stated!r}") from None
    if not 1 <= node_id <= 127:
        raise UsageError(f"{path}: {name}: node_id: expected 1 to 127, got {node_id}")
    return ListedNode(name, node_id, eds)


def _find(path: Path, dcf: str, dcf_path: str) -> Path | None:
    """The file that `dcf` means; None where it is nowhere."""
    beside, named = path.parent, Path(dcf.replace(_FOLDER_VARIABLE, str(path.parent.resolve())))
    folder = beside / dcf_path.replace(_FOLDER_VARIABLE, str(beside.resolve()))
    tried = (folder / named, beside / named, folder / named.name, beside / named.name)
    return next((candidate for candidate in tried if candidate.is_file()), None)
