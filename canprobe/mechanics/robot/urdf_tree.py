"""The links and joints of a URDF as a tree, with the numbers of its elements checked.

Every message names the file and the joint or link, what was expected, and what was found.

Source: URDF specification (wiki.ros.org/urdf/XML, joint, link, inertial).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from canprobe.errors import PlanError, regular_file
from canprobe.mechanics.robot.denavit_hartenberg import rotation_rpy
from canprobe.mechanics.robot.model import Body, Joint, negative_inertia
from canprobe.mechanics.types import Floats

MAX_FILE_BYTES = 64 << 20
"""Largest size of a URDF, bytes."""
_MOVING_KINDS = {"revolute", "continuous", "prismatic"}
_XACRO_DEFINITIONS = {"xacro:property", "xacro:macro", "xacro:arg"}
_LATE_DECLARATION = re.compile(rb"\A(?P<before>(?:\s|<!--.*?-->)+)(?P<declaration><\?xml\b.*?\?>)", re.DOTALL)
CONTINUOUS_RAD = 2 * math.pi
"""Assumed stops of a continuous joint to either side, rad: the joint has none, but cables and drive counts do."""


@dataclass(frozen=True, slots=True, eq=False)
class UrdfEdge:
    """A joint of the file, from its parent link to its child link."""

    element: ElementTree.Element
    name: str
    kind: str
    parent: str
    child: str
    T_parent_child: Floats


@dataclass(frozen=True, slots=True, eq=False)
class UrdfTree:
    """Links and joints of a file."""

    where: str
    name: str
    links: dict[str, ElementTree.Element]
    colours: dict[str, tuple[int, int, int]]
    """RGB of each named material."""
    into: dict[str, UrdfEdge]
    """The joint that carries each link."""

    @classmethod
    def read(cls, source: str | Path) -> UrdfTree:
        """Read the file, or its text."""
        text, where = str(source), source_name(source)
        try:
            is_text = where == "URDF text"
            root = _parsed(text.encode() if is_text else regular_file(Path(source), MAX_FILE_BYTES).read_bytes())
        except OSError as error:
            raise PlanError([f"{where}: cannot be read: {error.strerror or error}"]) from error
        except expat.ExpatError as error:
            raise PlanError([f"{where}: expected XML: {error}"]) from error
        if root.tag != "robot":
            raise PlanError([f"{where}: expected a <robot>, got <{root.tag}>"])
        if _is_xacro(root):
            name = "arm.xacro" if where == "URDF text" else Path(text).name
            raise PlanError([f"{where}: it is a xacro; expand it first: pip install xacro; xacro {name} > arm.urdf"])
        links: dict[str, ElementTree.Element] = {}
        for link in root.iterfind("link"):
            if (name := link.get("name", "")) in links:
                raise PlanError([f"{where}: link {name}: expected one <link> of this name, got two; rename one"])
            links[name] = link
        tree = cls(where, root.get("name", "arm"), links, {}, {})
        for element in root.iterfind("joint"):
            edge = tree._edge(element)
            if (other := tree.into.get(edge.child)) is not None:
                raise tree.wrong(edge.name, "a child that hangs on one joint", f"{edge.child!r}, as of {other.name}")
            tree.into[edge.child] = edge
        tree.root()  # every file has one
        for material in root.iter("material"):
            if (colour := _colour(material)) is not None:
                tree.colours.setdefault(material.get("name", ""), colour)
        return tree

    def _edge(self, element: ElementTree.Element) -> UrdfEdge:
        name = element.get("name", "?")
        parent, child = element.find("parent"), element.find("child")
        if parent is None or child is None:
            raise self.wrong(name, "<parent> and <child>", "one of them is missing")
        for end in (parent, child):
            if end.get("link") not in self.links:
                raise self.wrong(name, f"a link of the file in <{end.tag}>", repr(end.get("link")))
        return UrdfEdge(
            element=element,
            name=name,
            kind=element.get("type", "?"),
            parent=parent.get("link", ""),
            child=child.get("link", ""),
            T_parent_child=self.origin(name, element.find("origin")),
        )

    def wrong(self, joint: str, expected: str, got: str) -> PlanError:
        """The error for a joint or link."""
        return PlanError([f"{self.where}: {joint}: expected {expected}, got {got}"])

    def root(self) -> str:
        """The link that hangs on no other."""
        roots = [link for link in self.links if link not in self.into]
        if len(roots) != 1:
            got = f"{len(roots)}: {', '.join(roots)}; join them" if roots else "none: its joints make a loop"
            raise PlanError([f"{self.where}: expected one <link> that hangs on no other, got {got}"])
        return roots[0]

    def only_end(self, base: str) -> str:
        """The only link without children, or of several the only one that drives can move from a base.

        Raises:
            PlanError: it has to be chosen; the message names those that drives can move.
        """
        parents = {edge.parent for edge in self.into.values()}
        ends = [link for link in self.links if link not in parents]
        if len(ends) == 1:
            return ends[0]
        moved = [link for link in ends if self._can_be_driven(base, link)]
        if len(moved) != 1:
            raise PlanError([f"{self.where}: name the tip (--tip LINK, or arm.tip): one of {', '.join(moved or ends)}"])
        return moved[0]

    def _can_be_driven(self, base: str, tip: str) -> bool:
        """Whether a joint moves a link, and drives can move every joint on the way to it."""
        try:
            return any([self.joint(edge) for edge in self.path(base, tip) if edge.kind != "fixed"])
        except PlanError:
            return False

    def path(self, base: str, tip: str) -> list[UrdfEdge]:
        """The joints from base to tip."""
        for link in (base, tip):
            if link not in self.links:
                raise PlanError([f"{self.where}: no link {link!r}; it has {', '.join(sorted(self.links))}"])
        path: list[UrdfEdge] = []
        link = tip
        while link != base:
            edge = self.into.get(link)
            if edge is None or len(path) > len(self.into):
                raise PlanError(
                    [f"{self.where}: {tip!r} does not hang on {base!r}, but on {link!r}; choose a base above the tip"]
                )
            path.insert(0, edge)
            link = edge.parent
        return path

    def joint(self, edge: UrdfEdge) -> Joint:
        """Limits, friction and torque of a joint of the path."""
        if edge.kind not in _MOVING_KINDS:
            kinds = "revolute, continuous, prismatic or fixed on the way to the tip"
            raise self.wrong(edge.name, kinds, edge.kind)
        mimic = edge.element.find("mimic")
        if mimic is not None:
            raise self.wrong(edge.name, "a joint with a drive of its own", f"a mimic of {mimic.get('joint')}")
        limit, dynamics = edge.element.find("limit"), edge.element.find("dynamics")
        low, high = -CONTINUOUS_RAD, CONTINUOUS_RAD
        if edge.kind != "continuous":
            if limit is None:
                raise self.wrong(edge.name, "a <limit> with lower, upper and velocity", "none")
            low, high = self.number(edge.name, limit, "lower"), self.number(edge.name, limit, "upper")
            if low > high:
                raise self.wrong(edge.name, "lower below upper in its <limit>", f"{low:g} and {high:g}")
        low, high = self._softened(edge, low, high)
        given = {
            "rated_torque": self.number(edge.name, limit, "effort"),
            "coulomb": self.number(edge.name, dynamics, "friction"),
            "viscous": self.number(edge.name, dynamics, "damping"),
        }
        return Joint(
            name=edge.name,
            prismatic=edge.kind == "prismatic",
            q_min=low,
            q_max=high,
            qd_max=self.number(edge.name, limit, "velocity"),
            **{key: value for key, value in given.items() if value > 0.0},
        )

    def _softened(self, edge: UrdfEdge, low: float, high: float) -> tuple[float, float]:
        """The range within the soft limits of a <safety_controller>, which has none where both are 0."""
        safety = edge.element.find("safety_controller")
        if safety is None:
            return low, high
        soft = [self.number(edge.name, safety, f"soft_{end}_limit") for end in ("lower", "upper")]
        if soft == [0.0, 0.0]:
            return low, high
        inside = max(low, soft[0]), min(high, soft[1])
        if inside[0] > inside[1]:
            expected = f"soft limits in {low:g} to {high:g} in its <safety_controller>"
            raise self.wrong(edge.name, expected, f"{soft[0]:g} and {soft[1]:g}")
        return inside

    def axis(self, edge: UrdfEdge) -> Floats:
        """(3,) unit vector of the joint's axis in its frame."""
        element = edge.element.find("axis")
        axis = np.array((1.0, 0.0, 0.0) if element is None else self.numbers(edge.name, element, "xyz"))
        length = float(np.linalg.norm(axis))
        if length < 1e-6:
            raise self.wrong(edge.name, "an axis that is not zero", str(axis.tolist()))
        return axis / length

    def body(self, edge: UrdfEdge, path: set[str], turned: Floats) -> Body | None:
        """Everything that a joint of the path carries up to the next one, branches included, in its turned frame."""
        parts = ((link, self.links[link].find("inertial"), T) for link, T in self.carried(edge.child, path, turned.T))
        found = [self._inertial(link, element, T) for link, element, T in parts if element is not None]
        if not sum(body.mass for body in found) > 0.0:
            return None
        together = Body.combined(found)
        # checked for the sum only: real files have sensors and fingertips with values that no body has
        if (why := negative_inertia(together.tensor)) is not None:
            raise self.wrong(f"link {edge.child}, with what it carries", "an <inertia> that a body can have", why)
        return together

    def colour_of(self, material: ElementTree.Element | None) -> tuple[int, int, int] | None:
        """RGB of a material, by itself or by its name; None where the file gives none."""
        return None if material is None else _colour(material) or self.colours.get(material.get("name", ""))

    def carried(self, link: str, path: set[str], T: Floats) -> Iterator[tuple[str, Floats]]:
        """A link that stands at T in some frame, and the links that it carries up to the next joint, there too."""
        if link in self.links:
            yield link, T
        for edge in self.into.values():
            if edge.parent == link and not (edge.name in path and edge.kind != "fixed"):
                yield from self.carried(edge.child, path, T @ edge.T_parent_child)

    def _inertial(self, link: str, element: ElementTree.Element, T: Floats) -> Body:
        mass, inertia = element.find("mass"), element.find("inertia")
        if mass is None or inertia is None:
            raise self.wrong(f"link {link}", "<mass> and <inertia> in its <inertial>", "one of them is missing")
        names = ("ixx", "ixy", "ixz", "ixy", "iyy", "iyz", "ixz", "iyz", "izz")
        tensor = np.array([self.number(f"link {link}", inertia, name) for name in names]).reshape(3, 3)
        body = Body(self.number(f"link {link}", mass, "value"), np.zeros(3), tensor)
        if body.mass < 0.0:
            raise self.wrong(f"link {link}", "a value in <mass> that is not negative", f"{body.mass:g}")
        return body.moved(T @ self.origin(f"link {link}", element.find("origin")))

    def origin(self, name: str, element: ElementTree.Element | None) -> Floats:
        """(4, 4) transform of an <origin>: roll, pitch and yaw about fixed axes, then the translation."""
        T = np.eye(4)
        if element is None:
            return T
        T[:3, :3] = rotation_rpy(*self.numbers(name, element, "rpy", "0 0 0"))
        T[:3, 3] = self.numbers(name, element, "xyz", "0 0 0")
        return T

    def numbers(self, name: str, element: ElementTree.Element, key: str, default: str = "", n: int = 3) -> list[float]:
        """Three numbers of an attribute, or one; `default` where it is missing."""
        text = element.get(key, default)
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        if len(values) != n or not all(map(math.isfinite, values)):
            expected = "a number" if n == 1 else "three numbers"
            raise self.wrong(name, f"{expected} in {key} of <{element.tag}>", repr(text or None))
        return values

    def number(self, name: str, element: ElementTree.Element | None, key: str, default: str = "0") -> float:
        """A number of an attribute; `default` where it or the element is missing."""
        return 0.0 if element is None else self.numbers(name, element, key, default, n=1)[0]


def source_name(source: str | Path) -> str:
    """Name of a file, or of its text, in messages."""
    return "URDF text" if str(source).lstrip().startswith("<") else f"URDF {source}"


def _parsed(content: bytes) -> ElementTree.Element:
    """The XML of a URDF as common readers take it: undeclared prefixes are a part of names."""
    content = content.removeprefix(b"\xef\xbb\xbf")
    if late := _LATE_DECLARATION.match(content):
        content = late["declaration"] + late["before"] + content[late.end() :]
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.Parse(content, True)
    return builder.close()


def _is_xacro(element: ElementTree.Element) -> bool:
    """Whether something is still to be expanded; definitions that nothing uses are left over."""
    for child in element:
        if child.tag in _XACRO_DEFINITIONS:
            continue
        if child.tag.startswith("xacro:") or any("${" in value or "$(" in value for value in child.attrib.values()):
            return True
        if _is_xacro(child):
            return True
    return element.tag == "robot" and element.find("link") is None and any(c.tag in _XACRO_DEFINITIONS for c in element)


def _colour(material: ElementTree.Element) -> tuple[int, int, int] | None:
    """RGB of a material; None where it has none, or one that is not four numbers."""
    element = material.find("color")
    try:
        red, green, blue, _ = (round(255 * float(word)) for word in element.get("rgba", "").split())  # type: ignore[union-attr]
    except (AttributeError, ValueError):
        return None
    return red, green, blue


def z_along(axis: Floats) -> Floats:
    """(4, 4) rotation that turns z into a unit vector the short way; one that points down is first turned over x."""
    T = np.eye(4)
    over = np.diag((1.0, -1.0, -1.0)) if axis[2] < 0.0 else np.eye(3)
    x, y, z = (over @ axis).tolist()
    k = 1.0 / (1.0 + z)
    T[:3, :3] = over @ ((1.0 - k * x * x, -k * x * y, x), (-k * x * y, 1.0 - k * y * y, y), (-x, -y, z))
    return T
