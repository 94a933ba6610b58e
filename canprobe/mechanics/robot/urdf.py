"""A serial arm out of a URDF: its chain from a base link to a tip link, what its joints can do, its bodies.

Fixed joints are folded into the transforms beside them. A joint's own frame is turned until its axis is z, as `Chain`
has it. What hangs off the path (a gripper, a cover) stands still at its zero and counts as a body of the link that
carries it. What links look like is read apart (`visuals_of`): only a view needs it.

Source: URDF specification (wiki.ros.org/urdf/XML, joint, link, inertial, visual).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.parsers import expat
from xml.sax.saxutils import unescape

import numpy as np

from canprobe.errors import PlanError, regular_file
from canprobe.mechanics.robot.chain import MOST_JOINTS, Array, Chain
from canprobe.mechanics.robot.denavit_hartenberg import rotation_rpy
from canprobe.mechanics.robot.model import Body, Joint, lopsided_inertia, negative_inertia

CONTINUOUS_RAD = 2 * math.pi
"""Stops of a continuous joint to either side: it has none itself, but cables and the counts of a drive have."""
LARGEST_RAD = 4 * math.pi
"""A stop of a revolute joint beyond it looks like one in degrees."""
MOST_BYTES = 64 << 20
"""Size of a URDF."""
_MOVING = {"revolute", "continuous", "prismatic"}
_DEFINITIONS = {"xacro:property", "xacro:macro", "xacro:arg"}
_LATE_DECLARATION = re.compile(rb"\A(?P<before>(?:\s|<!--.*?-->)+)(?P<declaration><\?xml\b.*?\?>)", re.DOTALL)


@dataclass(frozen=True, slots=True, eq=False)
class UrdfArm:
    """What a URDF says about an arm.

    Attributes:
        chain: from base to tip.
        joints: stops, speeds, friction; the effort limit stands for the rated torque. What the file leaves out has the
            defaults of `Joint`, but a speed limit that is missing is 0, which an `ArmModel` refuses.
        bodies: (n,) of the joints; None for one without any inertial.
        warnings: what the file says and hardly means.
    """

    chain: Chain
    joints: tuple[Joint, ...]
    bodies: tuple[Body | None, ...]
    warnings: tuple[str, ...] = ()


def from_urdf(
    source: str | Path, base: str | None = None, tip: str | None = None, *, name: str | None = None
) -> UrdfArm:
    """Read a serial arm out of a URDF.

    Args:
        source: path of the file, or its text.
        base: link that is the base frame; the root by default.
        tip: link whose frame is the flange; the only link without children by default.
        name: of the arm; the robot's by default.

    Raises:
        PlanError: no URDF, no path from base to tip, a joint on the path that a drive cannot move, or what `Chain`
            refuses.
    """
    tree = _Tree.read(source)
    path = tree.path(base or tree.root(), tip or tree.only_end())
    moving = [edge for edge in path if edge.kind != "fixed"]
    if len(moving) > MOST_JOINTS:
        raise PlanError(
            [
                f"{tree.where}: {len(moving)} joints move between {path[0].parent!r} and {path[-1].child!r}, at most"
                f" {MOST_JOINTS} can; choose a base nearer to the tip, such as --base {moving[-MOST_JOINTS].parent}"
                " (arm.base)"
            ]
        )
    places, joints, bodies = [], [], []
    T = np.eye(4)  # from the last joint's frame, its axis along z, to where the path has come
    turned = np.eye(4)  # of that frame within the frame that the file gives the joint
    for edge in path:
        T = T @ edge.T_parent_child
        if edge.kind == "fixed":
            continue
        joints.append(tree.joint(edge))
        turned = _z_along(tree.axis(edge))
        places.append(T @ turned)
        bodies.append(tree.body(edge, {other.name for other in path}, turned))
        T = turned.T  # the inverse of a rotation
    if not joints:
        raise PlanError([f"{tree.where}: no joint moves between {base!r} and {tip!r}; choose other links"])
    chain = Chain(
        name=name or tree.name,
        joints=tuple(joint.name for joint in joints),
        prismatic=tuple(joint.prismatic for joint in joints),
        fixed=np.array(places),
        T_last_flange=T,
    )
    warnings = [limit_warning(source, joint) for joint in joints]
    for edge, body in zip(moving, bodies, strict=True):
        if body is not None and (why := lopsided_inertia(body.tensor)) is not None:
            warnings.append(f"{tree.where}: link {edge.child}, with what it carries: no body has {why}; correct it")
    return UrdfArm(chain, tuple(joints), tuple(bodies), tuple(filter(None, warnings)))


def limit_warning(source: str | Path, joint: Joint) -> str | None:
    """What is said of the stops of a joint that look like degrees; None where they do not.

    Args:
        source: path of the file, or its text.
        joint: as `from_urdf` read it.
    """
    if joint.prismatic or max(-joint.q_min, joint.q_max) <= LARGEST_RAD:
        return None
    return (
        f"{_named(source)}: {joint.name}: <limit> from {joint.q_min:g} to {joint.q_max:g} rad looks like degrees;"
        " correct it, or set min_deg and max_deg of the joint"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Visual:
    """One solid that a URDF shows.

    Attributes:
        joint: number of the joint that moves it, from 1; 0 where it stands with the base.
        T: (4, 4) the solid in the frame of that joint in the chain of `from_urdf`, of the base for 0, m.
        kind: "mesh", "box", "cylinder" along z, or "sphere".
        size: of a mesh (3,) what its coordinates are multiplied by; of a box its edges, of a cylinder radius and
            length, of a sphere its radius, m.
        mesh: name of the mesh file, as it stands in the URDF; "" of another kind.
        colour: RGB, 0–255; None where the URDF has none.
    """

    joint: int
    T: Array
    kind: str
    size: tuple[float, ...]
    mesh: str
    colour: tuple[int, int, int] | None


def visuals_of(source: str | Path, base: str | None = None, tip: str | None = None) -> list[Visual]:
    """What the links from base to tip look like, with what hangs on them; as `from_urdf`.

    Args:
        source: path of the file, or its text.
        base, tip: links, as of `from_urdf`.

    Raises:
        PlanError: as `from_urdf`, or a solid without its numbers.
    """
    tree = _Tree.read(source)
    start = base or tree.root()
    path = tree.path(start, tip or tree.only_end())
    names = {edge.name for edge in path}
    found = list(tree.visuals(0, start, names, np.eye(4)))
    for number, edge in enumerate((edge for edge in path if edge.kind != "fixed"), start=1):
        found += tree.visuals(number, edge.child, names, _z_along(tree.axis(edge)).T)
    return found


def find_mesh(urdf: Path, name: str) -> Path | None:
    """The file of a mesh: beside the URDF or in a folder above it; None where it is not there.

    Args:
        urdf: path of the file that names it.
        name: a path relative to the URDF, `file://`, or `package://PACKAGE/…`. A package is looked for above the URDF;
            a folder above it that has the rest of the path will do.
    """
    folder, scheme = urdf.absolute().parent, name.partition("://")[0] if "://" in name else ""
    rest = name.removeprefix(f"{scheme}://")
    if scheme == "package":
        inside = rest.partition("/")[2]
        places = [above / part for above in (folder, *folder.parents) for part in (rest, inside)]
    else:
        places = [folder / (unquote(rest) if scheme == "file" else rest)] if scheme in ("", "file") else []
    return next(filter(_is_file, places), None)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that the system refuses
        return False


def with_meshes_found(urdf: Path) -> bytes:
    """The content of a URDF, with absolute `file://` paths of the meshes that are found: a copy of it finds them too.

    Args:
        urdf: path of the file.
    """

    def absolute(match: re.Match[bytes]) -> bytes:
        found = find_mesh(urdf, unescape(match[2].decode(errors="replace"), {"&quot;": '"', "&apos;": "'"}))
        return match[0] if found is None else match[1] + found.as_uri().encode() + match[3]

    return re.sub(
        rb"""(<mesh\b[^>]*?\bfilename\s*=\s*["'])([^"']*)(["'])""",
        absolute,
        regular_file(urdf, MOST_BYTES).read_bytes(),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Edge:
    """A joint of the file."""

    element: ElementTree.Element
    name: str
    kind: str
    parent: str
    child: str
    T_parent_child: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Tree:
    """Links and joints of a file."""

    where: str
    name: str
    links: dict[str, ElementTree.Element]
    colours: dict[str, tuple[int, int, int]]
    """By the names of the materials."""
    into: dict[str, _Edge]
    """The joint that carries each link."""

    @classmethod
    def read(cls, source: str | Path) -> _Tree:
        text, where = str(source), _named(source)
        try:
            is_text = where == "URDF text"
            root = _parsed(text.encode() if is_text else regular_file(Path(source), MOST_BYTES).read_bytes())
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

    def _edge(self, element: ElementTree.Element) -> _Edge:
        name = element.get("name", "?")
        parent, child = element.find("parent"), element.find("child")
        if parent is None or child is None:
            raise self.wrong(name, "<parent> and <child>", "one of them is missing")
        for end in (parent, child):
            if end.get("link") not in self.links:
                raise self.wrong(name, f"a link of the file in <{end.tag}>", repr(end.get("link")))
        return _Edge(
            element=element,
            name=name,
            kind=element.get("type", "?"),
            parent=parent.get("link", ""),
            child=child.get("link", ""),
            T_parent_child=self._origin(name, element.find("origin")),
        )

    def wrong(self, joint: str, expected: str, got: str) -> PlanError:
        """What is wrong with a joint or link."""
        return PlanError([f"{self.where}: {joint}: expected {expected}, got {got}"])

    def root(self) -> str:
        """The link that hangs on no other."""
        roots = [link for link in self.links if link not in self.into]
        if len(roots) != 1:
            got = f"{len(roots)}: {', '.join(roots)}; join them" if roots else "none: its joints make a loop"
            raise PlanError([f"{self.where}: expected one <link> that hangs on no other, got {got}"])
        return roots[0]

    def only_end(self) -> str:
        """The link that carries no other; of several, that which a joint moves."""
        parents = {edge.parent for edge in self.into.values()}
        ends = [link for link in self.links if link not in parents]
        moved = [link for link in ends if any(edge.kind != "fixed" for edge in self.path(self.root(), link))]
        if len(ends) != 1:
            raise PlanError([f"{self.where}: name the tip (--tip LINK, or arm.tip): one of {', '.join(moved or ends)}"])
        return ends[0]

    def path(self, base: str, tip: str) -> list[_Edge]:
        """The joints from base to tip."""
        for link in (base, tip):
            if link not in self.links:
                raise PlanError([f"{self.where}: no link {link!r}; it has {', '.join(sorted(self.links))}"])
        path: list[_Edge] = []
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

    def joint(self, edge: _Edge) -> Joint:
        """What a joint of the path can do."""
        if edge.kind not in _MOVING:
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
            low, high = self._number(edge.name, limit, "lower", 0.0), self._number(edge.name, limit, "upper", 0.0)
            if low > high:
                raise self.wrong(edge.name, "lower below upper in its <limit>", f"{low:g} and {high:g}")
        low, high = self._softened(edge, low, high)
        given = {
            "rated_torque": 0.0 if limit is None else self._number(edge.name, limit, "effort", 0.0),
            "coulomb": 0.0 if dynamics is None else self._number(edge.name, dynamics, "friction", 0.0),
            "viscous": 0.0 if dynamics is None else self._number(edge.name, dynamics, "damping", 0.0),
        }
        return Joint(
            name=edge.name,
            prismatic=edge.kind == "prismatic",
            q_min=low,
            q_max=high,
            qd_max=0.0 if limit is None else self._number(edge.name, limit, "velocity", 0.0),
            **{key: value for key, value in given.items() if value > 0.0},
        )

    def _softened(self, edge: _Edge, low: float, high: float) -> tuple[float, float]:
        """The range within the soft limits of a <safety_controller>, which has none where both are 0."""
        safety = edge.element.find("safety_controller")
        if safety is None:
            return low, high
        soft = [self._number(edge.name, safety, f"soft_{end}_limit", 0.0) for end in ("lower", "upper")]
        if soft == [0.0, 0.0]:
            return low, high
        inside = max(low, soft[0]), min(high, soft[1])
        if inside[0] > inside[1]:
            expected = f"soft limits in {low:g} to {high:g} in its <safety_controller>"
            raise self.wrong(edge.name, expected, f"{soft[0]:g} and {soft[1]:g}")
        return inside

    def axis(self, edge: _Edge) -> Array:
        """(3,) unit vector in the joint's frame."""
        element = edge.element.find("axis")
        axis = np.array((1.0, 0.0, 0.0) if element is None else self._three(edge.name, element, "xyz"))
        length = float(np.linalg.norm(axis))
        if length < 1e-6:
            raise self.wrong(edge.name, "an axis that is not zero", str(axis.tolist()))
        unit: Array = axis / length
        return unit

    def body(self, edge: _Edge, path: set[str], turned: Array) -> Body | None:
        """All that a joint of the path carries up to the next one, with what hangs there, in its turned frame."""
        parts = ((link, self.links[link].find("inertial"), T) for link, T in self._carried(edge.child, path, turned.T))
        found = [self._inertial(link, element, T) for link, element, T in parts if element is not None]
        mass = sum(body.mass for body in found)
        if not mass > 0.0:
            return None
        com = np.sum([body.mass * body.com for body in found], axis=0) / mass
        tensor = np.zeros((3, 3))
        for body in found:
            off = body.com - com
            tensor += body.tensor + body.mass * (float(off @ off) * np.eye(3) - np.outer(off, off))
        # of all together: real files have sensors and fingertips with numbers that no body has
        if (why := negative_inertia(tensor)) is not None:
            raise self.wrong(f"link {edge.child}, with what it carries", "an <inertia> that a body can have", why)
        return Body(mass, com, tensor)

    def visuals(self, joint: int, link: str, path: set[str], T: Array) -> Iterator[Visual]:
        """Solids of a link and of what it carries, seen from the frame in which the link stands at T."""
        for name, there in self._carried(link, path, T):
            for element in self.links[name].iterfind("visual"):
                place = there @ self._origin(f"link {name}", element.find("origin"))
                for solid in element.iterfind("geometry/*"):
                    size = self._size(f"link {name}", solid)
                    colour = self._colour_of(element.find("material"))
                    yield Visual(joint, place, solid.tag, size, solid.get("filename", ""), colour)

    def _colour_of(self, material: ElementTree.Element | None) -> tuple[int, int, int] | None:
        return None if material is None else _colour(material) or self.colours.get(material.get("name", ""))

    def _size(self, name: str, solid: ElementTree.Element) -> tuple[float, ...]:
        keys = {"mesh": "scale", "box": "size", "cylinder": "radius length", "sphere": "radius"}.get(solid.tag, "")
        if solid.tag in ("mesh", "box"):
            return tuple(self._three(name, solid, keys, "1 1 1" if solid.tag == "mesh" else ""))
        return tuple(self._number(name, solid, key, math.nan) for key in keys.split())

    def _carried(self, link: str, path: set[str], T: Array) -> Iterator[tuple[str, Array]]:
        """A link that stands at T in some frame, and the links that it carries up to the next joint, there too."""
        if link in self.links:
            yield link, T
        for edge in self.into.values():
            if edge.parent == link and not (edge.name in path and edge.kind != "fixed"):
                yield from self._carried(edge.child, path, T @ edge.T_parent_child)

    def _inertial(self, link: str, element: ElementTree.Element, T: Array) -> Body:
        mass, inertia = element.find("mass"), element.find("inertia")
        if mass is None or inertia is None:
            raise self.wrong(f"link {link}", "<mass> and <inertia> in its <inertial>", "one of them is missing")
        names = ("ixx", "ixy", "ixz", "ixy", "iyy", "iyz", "ixz", "iyz", "izz")
        tensor = np.array([self._number(f"link {link}", inertia, name, 0.0) for name in names]).reshape(3, 3)
        body = Body(self._number(f"link {link}", mass, "value", 0.0), np.zeros(3), tensor)
        if body.mass < 0.0:
            raise self.wrong(f"link {link}", "a value in <mass> that is not negative", f"{body.mass:g}")
        return body.moved(T @ self._origin(f"link {link}", element.find("origin")))

    def _origin(self, name: str, element: ElementTree.Element | None) -> Array:
        """(4, 4) of an <origin>: roll, pitch and yaw about fixed axes, then the translation."""
        T = np.eye(4)
        if element is None:
            return T
        T[:3, :3] = rotation_rpy(*self._three(name, element, "rpy", "0 0 0"))
        T[:3, 3] = self._three(name, element, "xyz", "0 0 0")
        return T

    def _three(self, name: str, element: ElementTree.Element, key: str, default: str = "") -> list[float]:
        text = element.get(key, default)
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        if len(values) != 3 or not all(map(math.isfinite, values)):
            raise self.wrong(name, f"three numbers in {key} of <{element.tag}>", repr(text))
        return values

    def _number(self, name: str, element: ElementTree.Element, key: str, default: float) -> float:
        text = element.get(key)
        try:
            value = default if text is None else float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.wrong(name, f"a number in {key} of <{element.tag}>", repr(text))
        return value


def _named(source: str | Path) -> str:
    """What messages call a file, or its text."""
    return "URDF text" if str(source).lstrip().startswith("<") else f"URDF {source}"


def _parsed(content: bytes) -> ElementTree.Element:
    """The XML of a URDF as its readers take it: prefixes, which nobody declares, are a part of names."""
    content = content.removeprefix(b"\xef\xbb\xbf")
    if late := _LATE_DECLARATION.match(content):
        content = late["declaration"] + late["before"] + content[late.end() :]
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.Parse(content, True)
    root: ElementTree.Element = builder.close()
    return root


def _is_xacro(element: ElementTree.Element) -> bool:
    """Whether something is still to be expanded; definitions that nothing uses are left over."""
    for child in element:
        if child.tag in _DEFINITIONS:
            continue
        if child.tag.startswith("xacro:") or any("${" in value or "$(" in value for value in child.attrib.values()):
            return True
        if _is_xacro(child):
            return True
    return element.tag == "robot" and element.find("link") is None and any(c.tag in _DEFINITIONS for c in element)


def _colour(material: ElementTree.Element) -> tuple[int, int, int] | None:
    """RGB of a material; None where it has none, or one that is not four numbers."""
    element = material.find("color")
    try:
        red, green, blue, _ = (round(255 * float(word)) for word in element.get("rgba", "").split())  # type: ignore[union-attr]
    except (AttributeError, ValueError):
        return None
    return red, green, blue


def _z_along(axis: Array) -> Array:
    """(4, 4) rotation that turns z into a unit vector by a short way; one that points down is turned over before."""
    T = np.eye(4)
    over = np.diag((1.0, -1.0, -1.0)) if axis[2] < 0.0 else np.eye(3)
    x, y, z = (over @ axis).tolist()
    k = 1.0 / (1.0 + z)
    T[:3, :3] = over @ ((1.0 - k * x * x, -k * x * y, x), (-k * x * y, 1.0 - k * y * y, y), (-x, -y, z))
    return T
