"""A fault of a node or its link: when it holds, and how often; and the base class of its kinds."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import heappush
from pathlib import Path
from random import Random
from types import MappingProxyType
from typing import ClassVar

from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.frames import Frame

FOREVER_NS = 1 << 62
"""Duration of a fault without an end."""
ENDLESS_HITS = 1 << 62
DIRECTIONS = {"in": True, "out": False}
"""Whether a fault hits the frames that the node receives, by its direction."""
FACTS = tomllib.loads(Path(__file__).with_name("kinds.toml").read_text(encoding="utf-8"))
"""Facts of the kinds of faults by name."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number that a kind of fault takes.

    Attributes:
        default: value where none is given.
        low, high: range of the value.
        what: its meaning, with its unit.
    """

    default: float
    low: float
    high: float
    what: str


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes:
        kind: its kind, a row of the registry.
        node_id: id of the node.
        start_ns: beginning, on the clock of the bus; with an event it counts from then on only.
        duration_ns: duration.
        values: values of the kind's parameters by name; those left out have their defaults.
        share: share of the frames that it hits, 0…1.
        hits: number of frames after which it is over.
        incoming: whether it hits the frames that the node receives; else it hits those that the node sends. None: as
            the kind does.
        seed: seed of its random choices.
        event: event of the node at which it begins, one of `faulty_node.EVENTS`; empty: at `start_ns`.
    """

    kind: FaultKind
    node_id: int
    start_ns: int = 0
    duration_ns: int = FOREVER_NS
    values: Mapping[str, float] = field(default_factory=dict, hash=False)
    share: float = 1.0
    hits: int = ENDLESS_HITS
    incoming: bool | None = None
    seed: int = 0
    event: str = ""

    @property
    def end_ns(self) -> int:
        """End of the fault, on the clock of the bus."""
        return self.start_ns + self.duration_ns

    @property
    def hears(self) -> bool:
        """Whether it hits the frames that the node receives."""
        return bool(self.kind.incoming if self.kind.incoming is not None else self.incoming)

    def value(self, name: str) -> float:
        """The value of a parameter."""
        return self.values.get(name, self.kind.parameters[name].default)

    def __str__(self) -> str:
        return self.words(0)

    def words(self, now_ns: int) -> str:
        """The fault in words; its time counts from `now_ns`, and is negative where it has begun before."""
        way = " incoming" if self.hears and self.kind.incoming is None else ""
        given = "".join(f" {number_text(name, value)}" for name, value in self.values.items())
        begins = f"on {self.event}" if self.event else f"{(self.start_ns - now_ns) * 1e-9:.4f} s"
        lasts = "" if self.duration_ns >= FOREVER_NS else f" for {self.duration_ns * 1e-6:.1f} ms"
        return f"{self.kind.name}{way}{given} at node {self.node_id}, {begins}{lasts}, {100 * self.share:.0f} %"


@dataclass(slots=True)
class FaultSpan:
    """When a fault held, on the clock of the bus.

    Attributes:
        fault: the fault.
        name: name of the node or motor.
        begin_ns: its beginning.
        end_ns: its end; `FOREVER_NS` while it holds.
    """

    fault: Fault
    name: str
    begin_ns: int
    end_ns: int = FOREVER_NS

    @property
    def text(self) -> str:
        """Node, kind and values of the fault."""
        given = "".join(f" {name}={value:g}" for name, value in self.fault.values.items())
        return f"{self.name}: {self.fault.kind.name}{given}"


def number_text(name: str, value: float) -> str:
    """A number of a fault as it is typed: indices and codes of CANopen in hexadecimal."""
    return f"{name}=0x{int(value):X}" if name in ("index", "code") else f"{name}={value:g}"


class Host:
    """A node with faults, as their effects see it: beside its own frames it has those that they hold back or make up.

    Args:
        node: the node.

    Attributes:
        hits: number of frames that were changed, lost, moved or made up, and of reboots.
        late: heap of the frames that go on later: time, number, whether the node receives it, frame.
        swapped: frames that go on behind the next ones, by whether the node receives them.
        said: frames that the node did not make, to send with its next answers.
    """

    def __init__(self, node: SlaveNode) -> None:
        self.node, self.hits = node, 0
        self.late: list[tuple[int, int, bool, Frame]] = []
        self.swapped: dict[bool, list[Frame]] = {False: [], True: []}
        self.said: list[Frame] = []
        self._count = 0

    def later(self, frame: Frame, t_ns: int, *, incoming: bool) -> None:
        """Let a frame go on at `t_ns`."""
        self._count += 1
        heappush(self.late, (t_ns, self._count, incoming, frame))


class Effect:
    """A kind of fault: its facts, and what a fault of it does while it holds.

    A subclass with a name is a row of the registry, whose facts `kinds.toml` has. It overrides what it needs of the
    methods; here they do nothing.

    Args:
        fault: the fault.
        host: the node that has it.

    Attributes:
        name: name in texts, tests and studies.
        what: what happens.
        clause: clause or object of the standard that it breaks, or that says how to answer it.
        reaction: what a conforming peer does.
        conditions: keys of the supervision's conditions that it trips in a cell in motion, at full share.
        points: numbers of the points of `conform` that a drive fails with it; or "unanswered", or "most".
        parameters: its numbers by name.
        frames: service whose frames it changes, where it changes frames one by one; empty: all services.
        incoming: whether it hits frames that the node receives; None: either, as the fault says, else those it sends.
        needs: device that it needs: a node, a drive, or an array.
        lasts_ns: its duration where a text gives none.
        dark: whether the node neither sends nor hears nor computes.
        due_ns: time at which `advance` is called next; None: never.
        end_ns: time at which it ends.
        span: when it held.
        left: number of frames that it may still hit.
    """

    name: ClassVar[str]
    what: ClassVar[str] = ""
    clause: ClassVar[str] = ""
    reaction: ClassVar[str] = ""
    conditions: ClassVar[frozenset[str]] = frozenset()
    points: ClassVar[frozenset[str]] = frozenset()
    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType({})
    frames: ClassVar[str] = ""
    incoming: ClassVar[bool | None] = False
    needs: ClassVar[str] = "node"
    lasts_ns: ClassVar[int] = FOREVER_NS
    dark = False
    due_ns: int | None = None

    def __init_subclass__(cls) -> None:
        facts = FACTS.get(vars(cls).get("name", ""))
        if facts is None:
            return
        cls.what, cls.clause, cls.reaction = facts["what"], facts["clause"], facts["reaction"]
        cls.conditions, cls.points = (frozenset(facts.get(key, "").split()) for key in ("trips", "fails"))
        numbers = {name: Parameter(**number) for name, number in facts.get("parameters", {}).items()}
        cls.parameters, cls.frames = MappingProxyType(numbers), facts.get("frames", "")
        cls.incoming = DIRECTIONS.get(facts.get("direction", "out"))
        cls.lasts_ns = facts["lasts_ms"] * 1_000_000 if "lasts_ms" in facts else FOREVER_NS

    def __init__(self, fault: Fault, host: Host) -> None:
        self.fault, self.host, self.node = fault, host, host.node
        self.rng = Random(fault.seed)
        self.end_ns = fault.end_ns
        self.span = FaultSpan(fault, host.node.name, fault.start_ns)
        self.left = fault.hits

    def begin(self, t_ns: int) -> Sequence[Frame] | None:
        """Begin; return frames that the node sends because of it. None: nothing has happened so far."""
        return None

    def advance(self, t_ns: int) -> Sequence[Frame]:
        """Do what is due, and set `due_ns` anew."""
        return ()

    def end(self, t_ns: int) -> Sequence[Frame] | None:
        """End; leave the node as it would be without the fault. Frames that it sends because of it, if any."""
        return None

    def batch(self, frames: list[Frame], t_ns: int) -> list[Frame]:
        """Change the frames that the node sends at one time."""
        return frames

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Change one frame in the direction of the fault; None leaves it as it is."""
        return None

    def watch(self, t_ns: int) -> Sequence[Frame]:
        """Look at the node after it received or did something; return frames that it sends because of it."""
        return ()

    def act(self, t_ns: int, act: Callable[[], object]) -> Sequence[Frame]:
        """Let the device do something by itself now; return the frames that it sends."""
        self.node.core.now_ns = t_ns
        act()
        return self.node.advance(t_ns)


FaultKind = type[Effect]
