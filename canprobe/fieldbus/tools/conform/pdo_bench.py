"""PDOs of the device, taken out of use, changed and put to work for a point."""

from __future__ import annotations

from collections.abc import Mapping

from canprobe.fieldbus.eds.description import DescribedEntry
from canprobe.fieldbus.protocol.frames import INVALID_FLAG, RTR_FLAG
from canprobe.fieldbus.protocol.pdo import NO_RTR_FLAG, RPDOS, TO_MAPPING, TPDOS, PdoSub
from canprobe.fieldbus.tools.conform.bench import Bench
from canprobe.fieldbus.tools.conform.outcome import NotPermitted
from canprobe.fieldbus.tools.conform.permits import MOTION_OBJECTS, is_object

EVENT_TYPE = 255
_DUMMY_WORDS = (0x00070020, 0x00060010, 0x00050008)
"""UNSIGNED32, UNSIGNED16, UNSIGNED8 as dummy entries."""


class PdoBench(Bench):
    """The bench with the PDOs of the device: taken out of use, changed, put to work, and brought to be sent."""

    def find_pdo(self, area: range, *, mapping: bool = False) -> int | None:
        """A PDO with a mapping whose identifier can be written; with `mapping` its mapping can be written, too."""
        for pdo in self.device.pdos(area):
            places = ((pdo, 1), (pdo + TO_MAPPING, 0), (pdo + TO_MAPPING, 1))[: 3 if mapping else 1]
            if all(self.device.writable(*place) for place in places) and (area is RPDOS or self.device.mapping(pdo)):
                return pdo
        return None

    def changeable_pdo(self, area: range, *, mapping: bool = False) -> int:
        """The PDO that `find_pdo` finds. Raises PointNotApplicable where there is none."""
        if (pdo := self.find_pdo(area, mapping=mapping)) is None:
            what = f"{'TPDO' if area is TPDOS else 'RPDO'} {'with a mapping that' if mapping else 'that'}"
            self.does_not_apply(f"the device has no {what} can be changed")
        return pdo

    def switch_off(self, pdo: int) -> None:
        """Take a PDO out of use."""
        self.put(pdo, 1, self.device.number(pdo, 1) | INVALID_FLAG, 4)

    def idle_pdo(self, area: range, *, mapping: bool = False) -> int:
        """A PDO that can be changed, as `changeable_pdo` finds it, out of use."""
        pdo = self.changeable_pdo(area, mapping=mapping)
        self.switch_off(pdo)
        return pdo

    def switch_on(self, pdo: int) -> int:
        """Put a PDO to work under its own identifier, or the pre-defined one; return the identifier."""
        word = self.device.number(pdo, 1) & ~INVALID_FLAG
        if not word & 0x7FF:
            area, base = (RPDOS, 0x200) if pdo in RPDOS else (TPDOS, 0x180)
            word |= base + 0x100 * (area.index(pdo) % 4) + self.node_id
        self.put(pdo, 1, word, 4)
        return word & 0x7FF

    def map_entries(self, pdo: int, words: list[int]) -> None:
        """Map entries to a PDO that is out of use. Raises Deviation where the device refuses."""
        self.put(pdo + TO_MAPPING, 0, 0)
        for subindex, word in enumerate(words, start=1):
            self.put(pdo + TO_MAPPING, subindex, word, 4)
        self.put(pdo + TO_MAPPING, 0, len(words))

    def put_to_work(self, pdo: int, kind: int, *, inhibit: int = 0, event_ms: int = 0, start: int | None = None) -> int:
        """Set transmission type and times of a PDO that is out of use, and switch it on; return its identifier.

        Raises:
            PointNotApplicable: the device has not all of them, or does not take the transmission type.
        """
        if self.device.number(pdo, PdoSub.TYPE) != kind and not self.takes(pdo, PdoSub.TYPE, kind):
            self.does_not_apply(f"the device does not take transmission type {kind}")
        times = {PdoSub.INHIBIT_TIME: inhibit, PdoSub.EVENT_TIMER: event_ms, PdoSub.SYNC_START: start}
        for subindex, value in times.items():
            if value is not None and (value or self.device.number(pdo, subindex)):
                self.need((pdo, subindex))
                self.put(pdo, subindex, value)
        return self.switch_on(pdo)

    def synchronous_tpdo(self, every: int = 1, start: int | None = None) -> int:
        """A TPDO that is sent at every n-th SYNC; return its identifier. Without a start SYNC has no counter."""
        pdo = self.idle_pdo(TPDOS)
        if start is None:
            self.plain_sync()
        return self.put_to_work(pdo, every, start=start)

    def plain_sync(self) -> None:
        """Let the device expect SYNC without a counter, and not watch its period."""
        if self.device.number(0x1006):
            self.put(0x1006, 0, 0)
        if self.device.number(0x1019):
            self.put(0x1019, 0, 0)

    def permitted_entry(self, *, transmits: bool) -> DescribedEntry:
        """An entry that the user lets be written and that such a PDO may map.

        Raises:
            PointNotApplicable: there is none.
        """
        for entry in self.device.entries():
            mappable = entry.in_tpdo and entry.writable if transmits else entry.in_rpdo and entry.readable
            if is_object(entry.index, *MOTION_OBJECTS) or entry.index < 0x2000 or not entry.is_integer:
                continue
            if mappable and self.permits.written.permits(entry.place):
                return entry
        way = "a TPDO" if transmits else "an RPDO"
        self.does_not_apply(f"--write names no entry that {way} may map, and whose value can be read and written")

    def rpdo_of_dummies(self) -> tuple[int, int, int]:
        """An RPDO that carries nothing; return its index, identifier and length.

        Raises:
            PointNotApplicable: no mapping can be changed, or none takes a dummy.
        """
        pdo = self.idle_pdo(RPDOS, mapping=True)
        self.put(pdo + TO_MAPPING, 0, 0)
        word = next((word for word in _DUMMY_WORDS if self.takes(pdo + TO_MAPPING, 1, word)), 0)
        if not word or not self.takes(pdo + TO_MAPPING, 0, 1):
            self.does_not_apply("no RPDO takes a dummy entry, so none can be sent without changing something")
        return pdo, self._harmless(pdo, EVENT_TYPE), (word & 0xFF) // 8

    def rpdo_of(self, entry: DescribedEntry, kind: int) -> tuple[int, int]:
        """An RPDO of the started device with one entry that the user lets be written; its identifier, and the value."""
        pdo = self.idle_pdo(RPDOS, mapping=True)
        self.map_entries(pdo, [word_of(entry)])
        cob_id = self._harmless(pdo, kind)
        self.start()
        return cob_id, self.number(*entry.place)

    def _harmless(self, pdo: int, kind: int) -> int:
        cob_id = self.put_to_work(pdo, kind)
        self.permits.harmless.add(cob_id)
        return cob_id

    def syncs(self, cob_id: int, counters: list[int | None]) -> list[int]:
        """Send SYNCs one by one; return how many frames of a TPDO each brings."""
        found = []
        for counter in counters:
            self.taken(cob_id)
            self.sync(counter)
            self.pass_time(self.times.slack_s)
            found.append(len(self.taken(cob_id)))
        return found

    def request_pdos(self, pdos: Mapping[int, int]) -> None:
        """Send a remote request for each TPDO whose bit 30 allows it, where it may be sent."""
        for cob_id, pdo in pdos.items():
            if self.device.number(pdo, 1) & NO_RTR_FLAG:
                continue
            try:
                self.send(cob_id | RTR_FLAG)
            except NotPermitted:
                self.notes.append(f"no remote request for {cob_id:03X}h, which is not an identifier of this node alone")


def word_of(entry: DescribedEntry) -> int:
    """A described entry as a mapping entry."""
    return entry.index << 16 | entry.subindex << 8 | entry.bits
