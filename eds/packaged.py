"""The EDS files of the cell's nodes: the contract from which master and emulator are both configured.

    puma260_joint      nodes 1..6, a CiA 402 drive a joint    vendor CA5Eh, product 0260h, revision 0001_0000h
    tactile_array      node 16, 16 × 16 taxels                vendor CA5Eh, product 1616h, revision 0001_0000h
    tactile_array_fd   the same with PDOs of up to 64 bytes   vendor CA5Eh, product 161Fh, revision 0001_0000h

The vendor number is this project's own choice; CiA has not assigned it. Source of the format: CiA 306-1.
"""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from canprobe.errors import EdsError, did_you_mean

if TYPE_CHECKING:
    import canopen

    from canprobe.fieldbus.eds.reading import Reading


MISSED_SYNCS = 0x2000
"""Manufacturer's object of our drives: number of missed SYNCs after which the master counts as lost."""
MISSED_SYNCS_NAME = "Missed SYNCs tolerated"
SYNC_FACTOR = 0x200E
"""The like object of PRBT joints, and of others with these drives: number of SYNC periods without a SYNC."""
SYNC_FACTOR_NAME = "SYNC time-out factor"
LONG_PDOS = 0x2007
"""Manufacturer's object of our CAN FD array: 1 lets its TPDOs map up to 64 bytes; SDO stays classical."""
LONG_PDOS_NAME = "Long PDOs (CAN FD)"
FULL_SCALE = 0x2004
"""Manufacturer's object of our arrays: pressure of the largest count, Pa."""
FULL_SCALE_NAME = "Full scale pressure"
WINDOW_SIZE = 0x2008
"""Manufacturer's object of our arrays: number of taxels along the window that follows the contact."""
WINDOW_SIZE_NAME = "Window size"
_FOLDER = Path(__file__).resolve().parent


def eds_names() -> tuple[str, ...]:
    """Names of the packaged EDS files, sorted, without the suffix."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.eds")))


def eds_path(name: str) -> Path:
    """Path of a packaged EDS file.

    Args:
        name: name of the file, with or without the suffix .eds.

    Raises:
        EdsError: no packaged file has this name.
    """
    names = eds_names()
    stem = name.removesuffix(".eds")
    if stem in names:
        return _FOLDER / f"{stem}.eds"
    raise EdsError(
        f"EDS {name!r}: no such file, and no such packaged file{did_you_mean(stem, names)}; packaged are"
        f" {', '.join(names)}; another file needs its path"
    )


def has_missed_syncs(od: canopen.ObjectDictionary) -> bool:
    """Whether 2000h is that object here; drives of other makers use the index for something else."""
    return MISSED_SYNCS in od and od[MISSED_SYNCS].name == MISSED_SYNCS_NAME


def sync_patience(od: canopen.ObjectDictionary) -> int | None:
    """Index of the object for the number of missed SYNCs after which a drive stops by itself; None without one."""
    named = ((MISSED_SYNCS, MISSED_SYNCS_NAME), (SYNC_FACTOR, SYNC_FACTOR_NAME))
    return next((index for index, name in named if index in od and od[index].name == name), None)


def has_long_pdos(od: canopen.ObjectDictionary) -> bool:
    """Whether 2007h is that object here: the device can send PDOs in CAN FD frames."""
    return LONG_PDOS in od and od[LONG_PDOS].name == LONG_PDOS_NAME


def has_window_size(od: canopen.ObjectDictionary) -> bool:
    """Whether 2008h is that object here; without it the window has 8×8 taxels."""
    return WINDOW_SIZE in od and od[WINDOW_SIZE].name == WINDOW_SIZE_NAME


def has_full_scale(od: canopen.ObjectDictionary) -> bool:
    """Whether 2004h is that object here; without it the device does not state the pressure of its largest count."""
    return FULL_SCALE in od and od[FULL_SCALE].name == FULL_SCALE_NAME


def eds_file(source: str | os.PathLike[str]) -> Path:
    """Path of the file that a name or path means; a bare word names a packaged file, unless a file has that name.

    Raises:
        EdsError: there is no such file.
    """
    path = Path(source)
    if os.path.isfile(path):  # False also for what no system takes as a path
        return path
    if isinstance(source, str) and path.name == source:
        return eds_path(source)
    raise EdsError(f"EDS {str(source)!r}: no such file")


def _check_node_id(source: str | os.PathLike[str], node_id: int) -> None:
    if not 1 <= node_id <= 127:
        raise EdsError(f"EDS {str(source)!r}: node id {node_id} is not 1..127")


def load_eds(name_or_path: str | os.PathLike[str], node_id: int) -> canopen.ObjectDictionary:
    """Load an EDS, DCF, XDD or XDC file into canopen's object dictionary for one node.

    Planner, master and emulator each ask for the same file, and parsing costs 60 ms: they get one object. Treat it as
    read-only; a node keeps its values elsewhere.

    Args:
        name_or_path: packaged name (see `eds_names`) or path of any EDS file.
        node_id: node id, 1..127, which replaces $NODEID.

    Raises:
        EdsError: the file is missing, unreadable, or has faults that prevent its use; the message names the file and
            each fault. Warnings are accepted, see `check_eds`.
    """
    _check_node_id(name_or_path, node_id)
    path = eds_file(name_or_path)
    return _parse(path, path.stat().st_mtime_ns, node_id)


def check_eds(name_or_path: str | os.PathLike[str], node_id: int | None = None) -> Reading:
    """Read an EDS, DCF, XDD or XDC file with all findings.

    Args:
        name_or_path: packaged name or path, as for `load_eds`.
        node_id: node id, 1..127, which replaces $NODEID; None for that of the DCF, or else 1.

    Raises:
        EdsError: the file is missing or unreadable, or the node id is not 1..127.
    """
    if node_id is not None:
        _check_node_id(name_or_path, node_id)
    from canprobe.fieldbus.eds.reading import read_eds  # here, as it imports canopen, which --help must not pay for

    return read_eds(eds_file(name_or_path), node_id)


@lru_cache(maxsize=64)
def _parse(path: Path, _mtime_ns: int, node_id: int) -> canopen.ObjectDictionary:
    from canprobe.fieldbus.eds.reading import read_eds  # here, as above

    return read_eds(path, node_id, serving=False).usable()
