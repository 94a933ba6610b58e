"""The EDS files of the cell's nodes: the contract from which master and emulator are both configured.

    puma260_joint      nodes 1..6, a CiA 402 drive a joint    vendor CA5Eh, product 0260h, revision 0001_0000h
    tactile_array      node 16, 16 × 16 taxels                vendor CA5Eh, product 1616h, revision 0001_0000h
    encoder            node 17, of what carries the object  vendor CA5Eh, product 0406h, revision 0001_0000h
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
SYNC_FACTOR = 0x200E
"""The like object of PRBT joints, and of others with these drives: number of SYNC periods without a SYNC."""
LONG_PDOS = 0x2007
"""Manufacturer's object of our CAN FD array: 1 lets its TPDOs map up to 64 bytes; SDO stays classical."""
FULL_SCALE = 0x2004
"""Manufacturer's object of our arrays: pressure of the largest count, Pa."""
WINDOW_SIZE = 0x2008
"""Manufacturer's object of our arrays: number of taxels along the window that follows the contact; without it 8."""
KNOWN_NAMES = {
    MISSED_SYNCS: "Missed SYNCs tolerated",
    SYNC_FACTOR: "SYNC time-out factor",
    LONG_PDOS: "Long PDOs (CAN FD)",
    FULL_SCALE: "Full scale pressure",
    WINDOW_SIZE: "Window size",
}
"""Names by which these objects are known, as other makers use their indices for something else."""
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


def has_known(od: canopen.ObjectDictionary, index: int) -> bool:
    """Whether a device has the object of `KNOWN_NAMES` at this index."""
    return index in od and od[index].name == KNOWN_NAMES[index]


def sync_patience(od: canopen.ObjectDictionary) -> int | None:
    """Index of the object for the number of missed SYNCs after which a drive stops by itself; None without one."""
    return next((index for index in (MISSED_SYNCS, SYNC_FACTOR) if has_known(od, index)), None)


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
