"""A fault of a node or its link: its kind, when it holds, and how often; and the base class of what it does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Protocol

from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.frames import Frame

FOREVER_NS = 1 << 62
"""Duration of a fault without an end."""
ENDLESS_HITS = 1 << 62


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


@dataclass(frozen=True, eq=False, slots=True)
class FaultKind:
    """One row of the registry.

    Attributes:
        name: name in texts, tests and studies.
        what: what happens.
        clause: clause or object of the standard that it breaks, or that says how to answer it.
        reaction: what a conforming peer does.
        effect: class that makes it happen.
        conditions: keys of the supervision's conditions that it trips in a cell in motion, at full share.
        points: numbers of the points of `conform` that a drive fails with it, thrown from the start with `--motion`;
            or one of the words of `row`.
        parameters: its numbers by name.
        incoming: whether it hits frames that the node receives; None: either, as the fault says, else those it sends.
        needs: device that it needs: a node, a drive, or an array.
        lasts_ns: its duration where a text gives none.
    """

    name: str
    what: str
    clause: str
    reaction: str
    effect: Callable[[Fault, Host], Effect]
    conditions: frozenset[str] = frozenset()
    points: frozenset[str] = frozenset()
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    incoming: bool | None = None
    needs: str = "node"
    lasts_ns: int = FOREVER_NS


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes:
        kind: row of the registry.
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


def number_text(name: str, value: float) -> str:
    """A number of a fault as it is typed: indices and codes of CANopen in hexadecimal."""
    return f"{name}=0x{int(value):X}" if name in ("index", "code") else f"{name}={value:g}"


class Host(Protocol):
    """A node with faults, as an effect sees it; `faulty_node` has the class.

    Attributes:
        node: the node.
        hits: number of frames and events so far.
    """

    node: SlaveNode
    hits: int

    def later(self, frame: Frame, t_ns: int, *, incoming: bool) -> None:
        """Let a frame go on at `t_ns`."""

    def swap(self, frame: Frame) -> None:
        """Send a frame behind those that the node sends next."""

    def say(self, frame: Frame) -> None:
        """Send a frame that the node did not make, with its next answers."""


class Effect:
    """What one fault does while it holds. The base class does nothing; subclasses override what they need.

    Args:
        fault: the fault.
        host: the node that has it.

    Attributes:
        dark: whether the node neither sends nor hears nor computes.
        due_ns: time at which `advance` is called next; None: never.
        end_ns: time at which it ends.
        left: number of frames that it may still hit.
    """

    dark = False
    due_ns: int | None = None

    def __init__(self, fault: Fault, host: Host) -> None:
        self.fault, self.host, self.node = fault, host, host.node
        self.rng = Random(fault.seed)
        self.end_ns = fault.end_ns
        self.left = fault.hits

    def begin(self, t_ns: int) -> Sequence[Frame]:
        """Begin; return frames that the node sends because of it."""
        return ()

    def advance(self, t_ns: int) -> Sequence[Frame]:
        """Do what is due, and set `due_ns` anew."""
        return ()

    def end(self, t_ns: int) -> Sequence[Frame]:
        """End; leave the node as it would be without the fault."""
        return ()

    def batch(self, frames: list[Frame], t_ns: int) -> list[Frame]:
        """Change the frames that the node sends at one time."""
        return frames

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Change one frame in the direction of the fault; None leaves it as it is."""
        return None

    def watch(self, t_ns: int) -> Sequence[Frame]:
        """Look at the node after it received or did something; return frames that it sends because of it."""
        return ()
