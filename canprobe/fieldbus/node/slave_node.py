"""A CiA 301 slave without I/O: frames and time in, frames and the next deadline out.

    node = SlaveNode(od, node_id, application)
    frames = node.start(t_ns)                       # boot-up
    frames = node.receive(can_id, data, t_ns)       # any frame on the bus; it never raises
    frames = node.advance(t_ns)                     # everything due up to t_ns
    node.next_deadline_ns                           # when to call advance, or None

Source: CiA 301 (the clauses are cited in the services).
"""

from __future__ import annotations

from collections.abc import Callable, Container
from functools import partial

from canopen.objectdictionary import ObjectDictionary

from canprobe.fieldbus.bus.port import nothing
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.node.core import NodeCore, Route, Service
from canprobe.fieldbus.node.dictionary import Dictionary, key_of
from canprobe.fieldbus.node.emcy import Emergency
from canprobe.fieldbus.node.error_control import HeartbeatConsumer, HeartbeatProducer, NodeGuarding
from canprobe.fieldbus.node.lss import LssSlave
from canprobe.fieldbus.node.pdo import PdoEngine
from canprobe.fieldbus.node.quirks import Quirks
from canprobe.fieldbus.node.sdo_server import SdoServer
from canprobe.fieldbus.node.store import Store
from canprobe.fieldbus.node.sync import SyncConsumer
from canprobe.fieldbus.protocol.frames import NMT_GOALS, NMT_ID, Frame, NmtCommand, NmtState
from canprobe.fieldbus.protocol.lss import UNCONFIGURED_ID

OdOf = Callable[[int], ObjectDictionary]
"""Parser of a node's EDS for a node id."""
_COMMUNICATION_ERROR_STATES = {0: NmtState.PRE_OPERATIONAL, 2: NmtState.STOPPED}  # 1029h:01; 1: no change


class Application:
    """The function of a device on its CANopen node. The base class does nothing; subclasses override what they need."""

    def attach(self, node: SlaveNode) -> None:
        """Add checks, hooks and samplers to dictionary and PDOs; called once, at construction of the node."""

    def keep(self) -> bytes:
        """Bytes that "save" (1010h) stores of the device beside its dictionary."""
        return b""

    def recall(self, kept: bytes) -> None:
        """Take what was stored, before `reset`; it is empty when nothing was stored, or after "load" (1011h)."""

    def reset(self, t_ns: int) -> None:
        """Boot; the dictionary holds its defaults or what was stored."""

    def entered(self, t_ns: int) -> None:
        """Act on the new NMT state."""

    def sync(self, t_ns: int, counter: int) -> None:
        """Act on a SYNC in operational: values of synchronous RPDOs are stored, TPDOs are packed next."""

    def advance(self, t_ns: int) -> None:
        """Advance to `t_ns`; called before anything that the node does at that time."""

    def connection_lost(self, t_ns: int) -> None:
        """Act on the loss of the network: heartbeat consumer, life guarding, NMT stop."""


class SlaveNode(Participant):
    """One node, made from an EDS and an application.

    Attributes:
        core: state, dictionary and timers, which the services share.
        emcy, pdos, store: services that an application works with.
        application: function of the device.
        next_deadline_ns: time at which `advance` has something to do, or None.
        lss: LSS service; None where the node's id cannot be changed over the bus.
    """

    next_deadline_ns: int | None = None

    def __init__(
        self,
        od: ObjectDictionary,
        node_id: int,
        application: Application | None = None,
        od_of: OdOf | None = None,
        quirks: Quirks | None = None,
    ) -> None:
        """Make the node; it is silent until `start`.

        Args:
            od: parsed EDS, with $NODEID already put in.
            node_id: node id, 1–127; with 255 (`UNCONFIGURED_ID`) the node waits for LSS to give it one.
            application: function of the device; the default does nothing.
            od_of: parser of the same EDS for another node id; with it the node speaks LSS.
            quirks: difficulties of the node, such as a slow boot, during which nothing is served; None: it has none.
        """
        self.application = application if application is not None else Application()
        self.core = core = NodeCore(node_id, Dictionary(od), self, quirks if quirks is not None else Quirks())
        self._boot_timer = core.timers.new(self._boot)
        self._routes: dict[int, Route] = {}
        self._rerouted: Callable[[], None] = nothing
        self.emcy = Emergency(core)
        self.pdos = PdoEngine(core, self.emcy, self.application.sync)
        self.store = Store(core, self.application.keep)
        self._heartbeat = HeartbeatProducer(core)
        channels = [0x1200, *(index for index in range(0x1201, 0x1280) if core.dictionary.has_index(index))]
        self._od_of = od_of
        reset = partial(self._initialise, communication_only=True)
        self.lss = LssSlave(core, self.store, reset) if od_of is not None else None
        self._services: tuple[Service, ...] = (
            *([self.lss] if self.lss is not None else []),
            self.emcy,
            self.pdos,
            SyncConsumer(core, self.emcy, self.pdos.sync),
            HeartbeatConsumer(core, self.emcy, self._communication_error),
            NodeGuarding(core, self.emcy, self._communication_error),
            *(SdoServer(core, index) for index in channels),
            self._heartbeat,
        )
        core.reroute = self._reroute
        self.application.attach(self)

    @property
    def node_id(self) -> int:
        """Node id, 1–127, or 255 without one."""
        return self.core.node_id

    @property
    def name(self) -> str:
        return f"node {self.core.node_id}" if self.core.node_id != UNCONFIGURED_ID else "node without an id"

    @property
    def state(self) -> NmtState:
        """NMT state of the node."""
        return self.core.state

    @property
    def dictionary(self) -> Dictionary:
        """The node's object dictionary with its present values."""
        return self.core.dictionary

    @property
    def kind(self) -> type:
        """Class of the application, which is that of the device."""
        return type(self.application)

    def connect(self, rerouted: Callable[[], None]) -> None:
        self._rerouted = rerouted

    def start(self, t_ns: int) -> list[Frame]:
        self.core.now_ns = t_ns
        if self.lss is not None:
            self.lss.power_on()
        self._initialise(t_ns, communication_only=False)
        return self._taken()

    def receive(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        """Take any frame from the bus (a remote request has RTR_FLAG); return the answers. No frame makes it raise."""
        route = self._routes.get(can_id)
        if route is None:
            return []
        core = self.core
        due = self.next_deadline_ns
        # what is due at `t_ns` itself is left to `advance`, behind the frames that wait (see `lockstep`)
        if due is not None and due < t_ns:
            self._run(t_ns)
        core.now_ns = t_ns
        route(data, t_ns)
        if out := core.out:
            core.out = []
        return out

    def advance(self, t_ns: int) -> list[Frame]:
        self._run(t_ns)
        return self._taken()

    def act(self, t_ns: int, act: Callable[[SlaveNode], object]) -> list[Frame]:
        """Let the device do something by itself at `t_ns`, such as to report an error; return the frames."""
        self._run(t_ns)
        act(self)
        return self._taken()

    def _run(self, t_ns: int) -> None:
        self.core.now_ns = t_ns
        self.application.advance(t_ns)
        self.core.timers.run(t_ns)

    def _taken(self) -> list[Frame]:
        out = self.core.out
        if out:
            self.core.out = []
        return out

    def _nmt(self, data: bytes, t_ns: int) -> None:
        if len(data) != 2 or data[1] not in (0, self.core.node_id) or data[0] not in NMT_GOALS:
            return
        goal = NMT_GOALS[NmtCommand(data[0])]
        if goal is NmtState.INITIALISING:
            self._initialise(t_ns, data[0] == NmtCommand.RESET_COMMUNICATION)
        else:
            self._enter(goal, t_ns)

    def _adopt_node_id(self) -> None:
        """Use the id that LSS has configured, with the defaults that the EDS gives for it."""
        if self.lss is None or self._od_of is None or self.lss.pending == self.core.node_id:
            return
        self.core.node_id = self.lss.pending
        if self.core.node_id != UNCONFIGURED_ID:
            self.core.dictionary.take_defaults(self._od_of(self.core.node_id))

    def _initialise(self, t_ns: int, communication_only: bool) -> None:
        self.core.state = NmtState.INITIALISING
        self._adopt_node_id()
        self.application.entered(t_ns)
        self.store.recall(communication_only)
        for service in self._services:
            service.reset(t_ns)
        if not communication_only:
            self.application.recall(self.store.kept)
            self.application.reset(t_ns)
        self._reroute()
        if self.core.node_id == UNCONFIGURED_ID:
            return
        if boot_ns := self.core.quirks.boot_ns:
            self._boot_timer.arm(t_ns + boot_ns)
        else:
            self._boot(t_ns)

    def _boot(self, t_ns: int) -> None:
        self._heartbeat.boot_up(t_ns)
        self.core.state = NmtState.PRE_OPERATIONAL
        for service in self._services[:-1]:  # but the heartbeat: the boot-up message was its first
            service.entered(t_ns)
        self.application.entered(t_ns)
        self._reroute()

    def _enter(self, state: NmtState, t_ns: int) -> None:
        if state is self.core.state:
            return
        self.core.state = state
        for service in reversed(self._services):  # the heartbeat first
            service.entered(t_ns)
        self.application.entered(t_ns)
        self._reroute()

    def _communication_error(self, t_ns: int) -> None:
        self.application.connection_lost(t_ns)
        goal = _COMMUNICATION_ERROR_STATES.get(self.core.dictionary.number(0x1029, 1))
        if goal is NmtState.STOPPED or (goal is not None and self.core.state is NmtState.OPERATIONAL):
            self._enter(goal, t_ns)

    @property
    def listens(self) -> Container[int]:
        """Identifiers that this node takes now; it is always the same object, so that a bus may keep it."""
        return self._routes

    @property
    def patient(self) -> frozenset[int]:
        """Those of them that require nothing before the next SYNC."""
        return self.pdos.patient

    def _reroute(self) -> None:
        routes = self._routes
        routes.clear()
        if self.core.state is not NmtState.INITIALISING:
            for service in self._services:
                if self.core.state in service.states:
                    routes.update(service.routes())
            routes[NMT_ID] = self._nmt
        elif self.lss is not None and self.lss.unconfigured:
            routes.update(self.lss.routes())
        self._rerouted()


def set_serial_number(node: SlaveNode, serial: int) -> None:
    """Give a device its serial number, in which two devices of one EDS differ; without 1018h:04 it has none."""
    if key_of(0x1018, 4) in node.dictionary:
        node.dictionary.set_default(0x1018, 4, serial)
