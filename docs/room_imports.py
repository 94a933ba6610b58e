"""docs/img/imports.svg: which room of the package imports which, read from the source. `docs/generate.py` writes it."""

from __future__ import annotations

import ast
import glob
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "canprobe"
WINGS = {
    "fieldbus": ("protocol", "eds", "bus", "node", "drive", "motor", "vcan"),
    "mechanics": ("robot", "touch"),
    "cell": ("scene", "planning", "master", "tasks", "plant", "emulated", "session", "results", "recorded"),
    "": ("api",),
    "lab": ("bridge", "gym", "studies", "examples"),
    " ": ("cli",),
}
"""Rooms from the lowest to the highest, by wing; `errors`, which all import, and single modules are not drawn."""
COLOURS = dict(zip(WINGS, ("#e0f2fe", "#dcfce7", "#fef3c7", "#f1f5f9", "#fae8ff", "#f1f5f9"), strict=True))
ROOMS = [(wing, room) for wing, rooms in WINGS.items() for room in rooms]
STEP, LEFT, TOP = 26, 190, 100


def imports_between_rooms() -> set[tuple[str, str]]:
    """Pairs of a room and another that one of its modules imports, wherever in the module and for types too."""
    known = {room for _, room in ROOMS}
    pairs = set()
    for name in glob.glob("**/*.py", root_dir=PACKAGE, recursive=True):  # it follows the links eds and bridge
        here = _room(Path(name).with_suffix("").parts)
        for target in _imported(ast.parse((PACKAGE / name).read_text(encoding="utf-8"))):
            there = _room(tuple(target.split(".")[1:]))
            if here != there and {here, there} <= known:
                pairs.add((here, there))
    return pairs


def _imported(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module is not None and node.module.startswith("canprobe"):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("canprobe."))


def _room(parts: tuple[str, ...]) -> str:
    """The room of a module, from the parts of its name below the package; that of a wing's door is the wing."""
    return parts[1] if len(parts) > 1 and parts[0] in WINGS else parts[0] if parts else ""


def imports_svg() -> str:
    """A row for each room with a dot below each room that it imports; all dots lie left of the diagonal."""
    place = {room: i for i, (_, room) in enumerate(ROOMS)}
    wing_of = {room: wing for wing, room in ROOMS}
    size = STEP * len(ROOMS)
    svg = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {LEFT + size + 60} {TOP + size + 20}"'
        ' font-family="system-ui, \'DejaVu Sans\', Arial, sans-serif" font-size="14">',
        "  <title>Which room of the package imports which</title>",
        f'  <rect width="{LEFT + size + 60}" height="{TOP + size + 20}" rx="10" fill="#ffffff"/>',
    ]
    for wing, rooms in WINGS.items():
        first, length = STEP * place[rooms[0]], STEP * len(rooms)
        svg.append(f'  <rect x="{LEFT}" y="{TOP + first}" width="{size}" height="{length}" fill="{COLOURS[wing]}"/>')
        svg.append(f'  <text x="20" y="{TOP + first + 18}" fill="#64748b">{wing.strip()}</text>')
    for _, room in ROOMS:
        at = STEP * place[room]
        svg.append(f'  <text x="{LEFT - 10}" y="{TOP + at + 18}" text-anchor="end" fill="#0f172a">{room}</text>')
        x, y = LEFT + at + 18, TOP - 10
        svg.append(f'  <text transform="translate({x} {y}) rotate(-60)" fill="#0f172a">{room}</text>')
        svg.append(
            f'  <rect x="{LEFT + at}" y="{TOP + at}" width="{STEP}" height="{STEP}" fill="#334155" opacity="0.25"/>'
        )
    for here, there in sorted(imports_between_rooms(), key=lambda pair: (place[pair[0]], place[pair[1]])):
        x, y = LEFT + STEP * place[there] + STEP // 2, TOP + STEP * place[here] + STEP // 2
        colour = "#334155" if wing_of[here] == wing_of[there] else "#9a3412"
        svg.append(f'  <circle cx="{x}" cy="{y}" r="6" fill="{colour}"><title>{here} imports {there}</title></circle>')
    return "\n".join([*svg, "</svg>", ""])
