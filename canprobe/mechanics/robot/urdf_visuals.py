"""Solids of a URDF, visual or for collisions, in the frames of `from_urdf`, and the files of their meshes.

Source: URDF specification (wiki.ros.org/urdf/XML, link, visual, collision).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from os.path import isfile
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.sax.saxutils import unescape

import numpy as np

from canprobe.errors import regular_file
from canprobe.mechanics.robot.urdf_tree import MAX_FILE_BYTES, UrdfTree, z_along
from canprobe.mechanics.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Visual:
    """One solid of a URDF.

    Attributes:
        joint: number of the joint that moves it, from 1; 0 where it stands with the base.
        T: (4, 4) solid to the frame of that joint in the chain of `from_urdf`, or to the base for 0, m.
        kind: kind of solid: "mesh", "box", "cylinder" along z, or "sphere".
        size: (3,) factors on the coordinates of a mesh; edges (3,) of a box, radius and length of a cylinder, or radius
            of a sphere, m.
        mesh: name of the mesh file as in the URDF; "" for another kind.
        colour: RGB, 0–255; None where the URDF gives no colour.
    """

    joint: int
    T: Floats
    kind: str
    size: tuple[float, ...]
    mesh: str
    colour: tuple[int, int, int] | None


def visuals_of(
    source: str | Path, base: str | None = None, tip: str | None = None, tag: str = "visual"
) -> list[Visual]:
    """Solids of the links from base to tip, and of all that they carry.

    Args:
        source: path of the file, or its text.
        base, tip: names of links, as for `from_urdf`.
        tag: element of the solids, "visual" or "collision".

    Raises:
        PlanError: `from_urdf` would raise it, or a solid lacks its numbers.
    """
    tree = UrdfTree.read(source)
    start = base or tree.root()
    path = tree.path(start, tip or tree.only_end(start))
    names = {edge.name for edge in path}
    found = list(_visuals(tree, tag, 0, tree.carried(start, names, np.eye(4))))
    for number, edge in enumerate((edge for edge in path if edge.kind != "fixed"), start=1):
        found += _visuals(tree, tag, number, tree.carried(edge.child, names, z_along(tree.axis(edge)).T))
    return found


def _visuals(tree: UrdfTree, tag: str, joint: int, carried: Iterable[tuple[str, Floats]]) -> Iterator[Visual]:
    """Solids of links that stand at places in the frame of a joint."""
    for name, there in carried:
        for element in tree.links[name].iterfind(tag):
            place = there @ tree.origin(f"link {name}", element.find("origin"))
            for solid in element.iterfind("geometry/*"):
                size = _size(tree, f"link {name}", solid)
                colour = tree.colour_of(element.find("material"))
                yield Visual(joint, place, solid.tag, size, solid.get("filename", ""), colour)


def _size(tree: UrdfTree, name: str, solid: ElementTree.Element) -> tuple[float, ...]:
    if solid.tag in ("mesh", "box"):
        key, usual = ("scale", "1 1 1") if solid.tag == "mesh" else ("size", "")
        return tuple(tree.numbers(name, solid, key, usual))
    keys = {"cylinder": ("radius", "length"), "sphere": ("radius",)}.get(solid.tag, ())
    return tuple(tree.number(name, solid, key, "") for key in keys)


def find_mesh(urdf: Path, name: str) -> Path | None:
    """The file of a mesh: beside the URDF or in a folder above it; None where it is not found.

    Args:
        urdf: path of the URDF that names it.
        name: path relative to the URDF, `file://` URL, or `package://PACKAGE/…`. A package is searched for above the
            URDF; a folder there with the rest of the path is accepted too.
    """
    folder, scheme = urdf.absolute().parent, name.partition("://")[0] if "://" in name else ""
    rest = name.removeprefix(f"{scheme}://")
    if scheme == "package":
        inside = rest.partition("/")[2]
        places = [above / part for above in (folder, *folder.parents) for part in (rest, inside)]
    else:
        places = [folder / (unquote(rest) if scheme == "file" else rest)] if scheme in ("", "file") else []
    return next(filter(isfile, places), None)  # unlike Path.is_file, false for a name that the system refuses


def with_meshes_found(urdf: Path) -> bytes:
    """The content of a URDF with absolute `file://` paths of the meshes that are found, so that a copy finds them too.

    Args:
        urdf: path of the file.
    """

    def absolute(match: re.Match[bytes]) -> bytes:
        found = find_mesh(urdf, unescape(match[2].decode(errors="replace"), {"&quot;": '"', "&apos;": "'"}))
        return match[0] if found is None else match[1] + found.as_uri().encode() + match[3]

    return re.sub(
        rb"""(<mesh\b[^>]*?\bfilename\s*=\s*["'])([^"']*)(["'])""",
        absolute,
        regular_file(urdf, MAX_FILE_BYTES).read_bytes(),
    )
