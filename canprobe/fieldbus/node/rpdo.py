"""One RPDO: reception, length check, event timer, and the storing of its values.

Source: CiA 301, "RPDO", objects 1400h and 1600h; errors 8210h, 8220h, 8250h.
"""

from __future__ import annotations

from canprobe.fieldbus.node.core import NodeCore
from canprobe.fieldbus.node.dictionary import Slot, key_of
from canprobe.fieldbus.node.emcy import Emergency
from canprobe.fieldbus.node.pdo_rules import PdoRules
from canprobe.fieldbus.protocol.emcy import PDO_TOO_LONG_CODE, PDO_TOO_SHORT_CODE, RPDO_TIMEOUT_CODE
from canprobe.fieldbus.protocol.pdo import PdoLayout, PdoSub
from canprobe.fieldbus.protocol.sdo import SdoAbort


class Rpdo:
    """One receive PDO, compiled from its parameters by `configure`.

    Attributes:
        rules: rules for its parameters.
        cob_id: identifier, or None while the PDO is not valid.
        keys: mapped dictionary keys, without dummies.
        synchronous: whether values are stored at the next SYNC (types 0–240).
        pending: values that wait for that SYNC.
    """

    def __init__(self, core: NodeCore, emcy: Emergency, rules: PdoRules) -> None:
        self._core, self._emcy, self.rules = core, emcy, rules
        self._timer = core.timers.new(lambda _due_ns: emcy.report(RPDO_TIMEOUT_CODE, source=self))
        self._layout = PdoLayout(0, ())
        self._unpack = self._layout.raw_unpack
        self._slots: tuple[Slot, ...] = ()
        self.keys: tuple[int, ...] = ()
        self._event_ns = 0
        self.cob_id: int | None = None
        self.synchronous = False
        self.pending: tuple[int, ...] | None = None

    def configure(self) -> None:
        """Read the parameters. A PDO with an impossible mapping has no values."""
        dictionary, index = self._core.dictionary, self.rules.communication
        self.stop()
        if self._emcy.any:
            self._forgive()  # the errors of the old parameters
        self.cob_id = dictionary.number(index, PdoSub.COB_ID) & 0x7FF if self.rules.valid else None
        self._layout = PdoLayout(self.cob_id or 0, self.rules.present(), dictionary.number(index, PdoSub.TYPE))
        self._unpack = self._layout.raw_unpack  # the length is checked before
        self.keys = tuple(key_of(signal.index, signal.subindex) for signal in self._layout.signals)
        self._slots = tuple(dictionary.slot(key) for key in self.keys)
        self.synchronous = self._layout.synchronous
        self._event_ns = dictionary.number(index, PdoSub.EVENT_TIMER) * 1_000_000

    @property
    def patient(self) -> bool:
        """Whether a frame requires nothing before the next SYNC."""
        return self.synchronous and not self._event_ns

    def stop(self) -> None:
        """Forget what waits; the event timer starts again at the next reception."""
        self.pending = None
        self._timer.cancel()

    def receive(self, data: bytes, t_ns: int) -> None:
        """Take a frame with the identifier of this PDO."""
        length = self._layout.length
        if len(data) != length:
            if len(data) < length:
                self._emcy.report(PDO_TOO_SHORT_CODE, source=self)
                return
            self._emcy.report(PDO_TOO_LONG_CODE, source=self)
            data = data[:length]
        elif self._emcy.any:
            self._forgive()
        if self._event_ns:
            self._timer.arm(t_ns + self._event_ns)
        self.take(self._unpack(data))

    def take(self, values: tuple[int, ...]) -> None:
        """Take one value for each mapped entry but the dummies, for now or for the next SYNC."""
        if self.synchronous:
            self.pending = values
        else:
            self.apply(values)

    def apply(self, given: tuple[int, ...]) -> None:
        """Store the values, each as `Dictionary.write_value` does; one that it would refuse is dropped."""
        self.pending = None
        dictionary, reported = self._core.dictionary, []
        values, watched = dictionary.values, dictionary.watched
        for value, (key, subindex, low, high, checks, hooks) in zip(given, self._slots, strict=True):
            if not low <= value <= high:
                continue
            try:
                for check in checks:
                    check(subindex, value)
                values[key] = value
                for hook in hooks:
                    hook(subindex, value)
            except SdoAbort:
                continue
            if key in watched:
                reported.append(key)
        if reported:
            # one event for all: by one for each value a TPDO would go out with half of the new ones
            dictionary.written(reported)

    def _forgive(self) -> None:
        for code in (PDO_TOO_SHORT_CODE, PDO_TOO_LONG_CODE, RPDO_TIMEOUT_CODE):
            self._emcy.clear(code, self)
        self._emcy.clear(RPDO_TIMEOUT_CODE)  # that of a drive, which misses targets whatever PDO brings them
