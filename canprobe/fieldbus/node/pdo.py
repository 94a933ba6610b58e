"""All PDOs of a node: which frame goes where, and what a SYNC does.

At a SYNC in operational the values of waiting synchronous RPDOs are stored, the application moves on, and the TPDOs
whose turn it is are sampled and packed. TPDOs of equal type and start value are one group, so they always go together.
Source: CiA 301, "Process data object (PDO)", objects 1007h, 1019h, 18xxh:06.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence

from canprobe.fieldbus.node.core import DelayedFrames, NodeCore, Route, Service
from canprobe.fieldbus.node.dictionary import Value, key_of
from canprobe.fieldbus.node.emcy import Emergency
from canprobe.fieldbus.node.pdo_rules import PdoRules
from canprobe.fieldbus.node.rpdo import Rpdo
from canprobe.fieldbus.node.tpdo import BUFFERED_TYPE, Packing, Sampler, Tpdo
from canprobe.fieldbus.protocol.frames import Frame, NmtState
from canprobe.fieldbus.protocol.pdo import MAX_SYNC_TYPE, RPDOS, TPDOS, PdoLayout


class _Group:
    """TPDOs that a SYNC triggers together: every `every`-th SYNC, counted from the one with counter `start`.

    Attributes:
        samplers: functions that bring the values up to date.
        packing: identifier, packer and source of values of each TPDO.
    """

    def __init__(self, every: int, start: int) -> None:
        self.every, self.start = every, start
        self.first: int | None = None
        self.tpdos: list[Tpdo] = []
        self.samplers: list[Sampler] = []
        self.packing: list[Packing] = []


class PdoEngine(Service):
    """The PDOs of one node.

    Args:
        core: core of the node.
        emcy: EMCY producer for errors of an RPDO.
        on_sync: function that is called as `on_sync(t_ns, counter)` at a SYNC in operational, before TPDOs are packed.
    """

    states = frozenset({NmtState.OPERATIONAL})

    def __init__(self, core: NodeCore, emcy: Emergency, on_sync: Callable[[int, int], None]) -> None:
        self._core, self._on_sync = core, on_sync
        self._samplers: dict[int, Sampler] = {}
        self._waiting: list[Rpdo] = []
        self._groups: list[_Group] = []
        self._on_event: list[Tpdo] = []
        self._buffered: list[Tpdo] = []
        self._late = DelayedFrames(core, core.quirks.tpdo_delay_ns)
        self._count = self._sync_ns = self._window_ns = 0
        dictionary = core.dictionary
        self._rpdos = [Rpdo(core, emcy, PdoRules(dictionary, i, transmits=False)) for i in dictionary.indices_in(RPDOS)]
        self._tpdos = [Tpdo(core, PdoRules(dictionary, i, transmits=True)) for i in dictionary.indices_in(TPDOS)]
        self._all: list[Rpdo | Tpdo] = [*self._rpdos, *self._tpdos]
        for pdo in self._all:
            self._watch(pdo)
        dictionary.written = self._written
        dictionary.on_change(self._rebuild, 0x1007)

    def _watch(self, pdo: Rpdo | Tpdo) -> None:
        def reconfigure(subindex: int, value: Value) -> None:
            pdo.configure()
            if isinstance(pdo, Tpdo) and self._core.state is NmtState.OPERATIONAL:
                pdo.reconfigured(self._core.now_ns)
            self._rebuild()
            self._core.reroute()

        rules, dictionary = pdo.rules, self._core.dictionary
        dictionary.on_check(rules.communication, rules.check_communication)
        dictionary.on_check(rules.mapping, rules.check_mapping)
        dictionary.on_write(rules.communication, reconfigure)
        dictionary.on_write(rules.mapping, reconfigure)

    def on_trigger(self, index: int, sampler: Sampler) -> None:
        """Call `sampler(t_ns)` once before TPDOs that map `index` are packed."""
        self._samplers[index] = sampler

    def reset(self, t_ns: int) -> None:
        for pdo in self._all:
            pdo.configure()
        self._rebuild()

    def entered(self, t_ns: int) -> None:
        """Count SYNCs anew in operational; stay silent in other states."""
        for pdo in self._all:
            pdo.stop()
        self._late.clear()
        if self._core.state is NmtState.OPERATIONAL:
            self._groups = []  # with them goes their phase, which `_rebuild` keeps
            self._rebuild()
            for tpdo in self._on_event:
                tpdo.started(t_ns)

    def routes(self) -> Mapping[int, Route]:
        """Identifiers of RPDOs and of remote requests for TPDOs; PDOs may share an identifier."""
        routes: dict[int, Route] = {}
        for rpdo in self._rpdos:
            if rpdo.cob_id is not None:
                routes[rpdo.cob_id] = _both(routes.get(rpdo.cob_id), self._route(rpdo))
        for tpdo in self._tpdos:
            if tpdo.remote_id is not None:
                routes[tpdo.remote_id] = _both(routes.get(tpdo.remote_id), tpdo.remote)
        return routes

    @property
    def patient(self) -> frozenset[int]:
        """Identifiers of RPDOs whose frames can wait for the next SYNC, in operational."""
        if self._core.state is not NmtState.OPERATIONAL:
            return frozenset()
        used = [rpdo for rpdo in self._rpdos if rpdo.cob_id is not None]
        hasty = {rpdo.cob_id for rpdo in used if not rpdo.patient}
        return frozenset(rpdo.cob_id for rpdo in used if rpdo.cob_id is not None and rpdo.cob_id not in hasty)

    def _route(self, rpdo: Rpdo) -> Route:
        if not (self._window_ns and rpdo.synchronous):
            return rpdo.receive

        def inside_window(data: bytes, t_ns: int) -> None:
            if t_ns - self._sync_ns <= self._window_ns:
                rpdo.receive(data, t_ns)

        return inside_window

    @property
    def layouts(self) -> dict[int, PdoLayout]:
        """Layouts of the TPDOs in use, by identifier."""
        return {tpdo.layout.cob_id: tpdo.layout for tpdo in self._tpdos if tpdo.active}

    def rpdo(self, cob_id: int) -> Rpdo:
        """The RPDO with this identifier. Raises StopIteration where there is none."""
        return next(rpdo for rpdo in self._rpdos if rpdo.cob_id == cob_id)

    def receives(self, index: int) -> bool:
        """Whether an RPDO that is in use carries an object of `index`."""
        return any(key >> 8 == index for rpdo in self._rpdos if rpdo.cob_id is not None for key in rpdo.keys)

    def event(self, index: int, subindex: int = 0) -> None:
        """Report that a value of the device changed: TPDOs of type 0, 254 and 255 that carry it are due."""
        self._written((key_of(index, subindex),))

    def _written(self, keys: Sequence[int]) -> None:
        """Report values that changed together: one event for each TPDO that carries one of them."""
        if self._core.state is NmtState.OPERATIONAL:
            for tpdo in self._on_event:
                if any(key in tpdo.keys for key in keys):
                    tpdo.event(self._core.now_ns)

    def sync(self, t_ns: int, counter: int, elapsed: int) -> None:
        """Serve a SYNC in operational.

        Args:
            t_ns: time of the SYNC.
            counter: counter of the SYNC, 0 without one.
            elapsed: number of SYNCs since the last one that was heard, with the lost ones that the counter shows.
        """
        for group in self._triggered(t_ns, counter, elapsed):
            self._late.send(self._packed(group, t_ns), t_ns)  # what the frames carry is as old as the SYNC
        for tpdo in self._buffered:
            tpdo.sample(t_ns)
        for tpdo in self._on_event:
            if tpdo.requested:
                tpdo.send(t_ns)

    def exchange(self, t_ns: int, counter: int) -> list[tuple[int, tuple[int, ...]]]:
        """Serve a SYNC of a master that takes values: return COB-ID and values of the TPDOs whose turn it is."""
        groups, values = self._triggered(t_ns, counter, 1), self._core.dictionary.values
        return [(cob_id, fetch(values)) for group in groups for cob_id, _, fetch in group.packing]

    def _triggered(self, t_ns: int, counter: int, elapsed: int) -> list[_Group]:
        """Do what a SYNC does before TPDOs are packed; return the groups whose turn it is, with fresh values."""
        self._sync_ns = t_ns
        count = self._count = self._count + elapsed
        for rpdo in self._waiting:
            if rpdo.pending is not None:
                rpdo.apply(rpdo.pending)
        self._on_sync(t_ns, counter)
        groups = []
        for group in self._groups:
            first = group.first
            if first is None:
                # only the first by its counter, which begins again behind 1019h: that need be no multiple of the type
                if counter != group.start:
                    continue
                first = group.first = count
            if (count - first) % group.every == 0:
                groups.append(group)
                for sampler in group.samplers:
                    sampler(t_ns)
        return groups

    def _packed(self, group: _Group, t_ns: int) -> list[Frame]:
        values = self._core.dictionary.values
        try:
            return [(cob_id, pack(*fetch(values))) for cob_id, pack, fetch in group.packing]
        except (struct.error, TypeError):
            for tpdo in group.tpdos:
                tpdo.send(t_ns)  # the one with the value that does not fit raises, with its name
            raise

    def _rebuild(self) -> None:
        dictionary = self._core.dictionary
        self._window_ns = dictionary.number(0x1007) * 1000
        self._waiting = [rpdo for rpdo in self._rpdos if rpdo.cob_id is not None and rpdo.synchronous]
        active = [tpdo for tpdo in self._tpdos if tpdo.active]
        self._on_event = [tpdo for tpdo in active if tpdo.type == 0 or tpdo.by_event]
        self._buffered = [tpdo for tpdo in active if tpdo.type == BUFFERED_TYPE]
        dictionary.watched = frozenset(key for tpdo in self._on_event for key in tpdo.keys)
        counted = bool(dictionary.number(0x1019))
        groups: dict[tuple[int, int], _Group] = {}
        for tpdo in active:
            if 1 <= tpdo.type <= MAX_SYNC_TYPE:
                key = tpdo.type, tpdo.start if counted else 0
                groups.setdefault(key, _Group(*key)).tpdos.append(tpdo)
            else:
                tpdo.samplers = self._samplers_of([tpdo])
        phases = {(group.every, group.start): group.first for group in self._groups}
        self._groups = list(groups.values())
        for group in self._groups:  # a PDO that is written to in operational does not shift the phase of the others
            group.samplers = self._samplers_of(group.tpdos)
            group.packing = [tpdo.packing for tpdo in group.tpdos]
            group.first = phases.get((group.every, group.start), None if group.start else self._count)

    def _samplers_of(self, tpdos: list[Tpdo]) -> list[Sampler]:
        indices = dict.fromkeys(key >> 8 for tpdo in tpdos for key in tpdo.keys)
        return list(dict.fromkeys(self._samplers[index] for index in indices if index in self._samplers))


def _both(first: Route | None, second: Route) -> Route:
    if first is None:
        return second

    def route(data: bytes, t_ns: int) -> None:
        first(data, t_ns)
        second(data, t_ns)

    return route
