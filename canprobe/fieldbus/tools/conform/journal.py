"""The values of a device before its examination: on disk before the first write, and put back after each point.

A value is put back where the bench wrote it, or where the device booted meanwhile; it is read back afterwards. PDOs are
taken out of use first, and 1006h is 0 while 1019h is written, as the standard demands.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path

from canprobe.errors import UsageError, check_schema
from canprobe.fieldbus.bus.files import read_document, write_text
from canprobe.fieldbus.protocol.frames import INVALID_FLAG
from canprobe.fieldbus.protocol.pdo import PDO_OBJECTS, TO_MAPPING
from canprobe.fieldbus.protocol.sdo import Place, place_text
from canprobe.fieldbus.tools.conform.outcome import BenchFailure, Deviation
from canprobe.fieldbus.tools.conform.permits import WriteRule, rule_of
from canprobe.fieldbus.tools.conform.sdo_client import SdoClient, SdoRefused

SCHEMA = 1
"""Version of the snapshot."""
_KIND = "canprobe conform snapshot"
_MAX_BYTES = 1 << 24


class Journal:
    """The snapshot, and what has to be put back.

    Args:
        values: values that can be restored, by entry.
        path: file of the snapshot; None: it is kept in memory, as for a virtual bus.
        identity: identity of the device, by which `--restore` knows it.
        temporary: whether the file is removed when all is put back, and never replaces another.

    Raises:
        UsageError: a temporary file would replace the snapshot of another examination.

    Attributes:
        touched: entries that were written since the last `restore`.
    """

    def __init__(
        self, values: Mapping[Place, bytes], path: Path | None, identity: str, *, temporary: bool = False
    ) -> None:
        if temporary and path is not None and path.exists():
            raise UsageError(
                f"{path}: the snapshot of an examination that was cut off: put it back with --restore, or remove it"
            )
        self.values, self.path, self.identity = dict(values), path, identity
        self.touched: set[Place] = set()
        self._saved, self._temporary = path is None, temporary

    def note(self, place: Place) -> None:
        """Note that an entry is about to be written; the snapshot is on disk when this returns."""
        if not self._saved and self.path is not None:
            entries = {place_text(*at): value.hex() for at, value in sorted(self.values.items())}
            document = {"kind": _KIND, "schema": SCHEMA, "identity": self.identity, "values": entries}
            write_text(self.path, json.dumps(document, indent=1) + "\n")
            self._saved = True
        self.touched.add(place)

    def close(self) -> None:
        """Remove a temporary file, as all is put back."""
        if self._temporary and self._saved and self.path is not None:
            self.path.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: Path) -> Journal:
        """Read a snapshot; all of it counts as touched.

        Raises:
            UsageError: the file cannot be read, or is no snapshot.
        """

        def parse(text: str) -> Journal:
            document = json.loads(text)
            if document["kind"] != _KIND:
                raise ValueError("another kind of file")
            check_schema(path, document.get("schema", 1), SCHEMA, "put the device back with the canprobe that wrote it")
            entries = document["values"].items()
            values = {(int(name[:4], 16), int(name[6:], 16)): bytes.fromhex(value) for name, value in entries}
            return cls(values, None, str(document["identity"]))

        journal = read_document(path, _MAX_BYTES, parse, "a snapshot that canprobe conform wrote")
        journal.touched.update(journal.values)
        return journal

    def restore(self, bench: SdoClient, *, all_of_it: bool = False) -> list[str]:
        """Put back what differs, and read it back.

        Args:
            bench: the bench; the device must answer SDO.
            all_of_it: whether every entry is compared, as after a boot-up; else those that were touched.

        Returns:
            A line for each entry that was touched or differed.

        Raises:
            BenchFailure: an entry has another value than before and does not take the old one.
        """
        wanted = sorted(self.values if all_of_it else self.touched & self.values.keys())
        differing = [place for place in wanted if bench.present(place) != self.values[place]]
        for pdo in sorted({place[0] & ~TO_MAPPING for place in differing if place[0] in PDO_OBJECTS}):
            self._restore_pdo(bench, pdo)
        others = [place for place in differing if place[0] not in PDO_OBJECTS]
        if any(place[0] in (0x1006, 0x1019) for place in others):
            others = [place for place in others if place[0] not in (0x1006, 0x1019)]
            self._write(bench, (0x1006, 0), bytes(4))
            others += [place for place in ((0x1019, 0), (0x1006, 0)) if place in self.values]
        for place in [place for place in others if place[0] == 0x1016]:
            self._write(bench, place, bytes(4))  # two entries must not name one producer on the way
        for place in others:
            self._write(bench, place, self.values[place])
        wrong = [place for place in differing if bench.present(place) != self.values[place]]
        if wrong:
            raise BenchFailure(f"not restored: {', '.join(place_text(*place) for place in wrong)}")
        written = sorted(self.touched | set(differing))
        self.touched.clear()
        return [
            f"{place_text(*place)}: "
            + (f"restored to {self.values[place].hex(' ')}" if place in self.values else "written, nothing to put back")
            for place in written
        ]

    def _restore_pdo(self, bench: SdoClient, index: int) -> None:
        cob_id = int.from_bytes(self.values.get((index, 1), b""), "little")
        self._write(bench, (index, 1), (cob_id | INVALID_FLAG).to_bytes(4, "little"))
        mapping = [self.values[place] for place in _entries(self.values, index + TO_MAPPING)]
        if [bench.present(place) for place in _entries(self.values, index + TO_MAPPING)] != mapping:
            self._write(bench, (index + TO_MAPPING, 0), b"\0")
            for subindex, word in enumerate(mapping[1:], start=1):
                self._write(bench, (index + TO_MAPPING, subindex), word)
            self._write(bench, (index + TO_MAPPING, 0), mapping[0])
        for place in _entries(self.values, index):
            if place[1] > 1:
                self._write(bench, place, self.values[place])
        self._write(bench, (index, 1), self.values.get((index, 1), b""))

    def _write(self, bench: SdoClient, place: Place, value: bytes) -> None:
        """Write an entry; whether it took the value is found out when it is read back."""
        if place in self.values and value and bench.present(place) != value:
            with contextlib.suppress(SdoRefused, Deviation):
                bench.download(*place, value)


def _entries(values: Mapping[Place, bytes], index: int) -> list[Place]:
    return sorted(place for place in values if place[0] == index)


def restorable(values: Mapping[Place, bytes], permitted: Iterable[Place]) -> dict[Place, bytes]:
    """Those of the values that the examination may write and has to put back."""
    kept = set(permitted)
    rules = (WriteRule.CHANGED, WriteRule.IDENTIFIER, WriteRule.SAME)
    return {place: value for place, value in values.items() if place in kept or rule_of(place[0]) in rules}
