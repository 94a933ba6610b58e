"""Whether an STL file is whole. Its readers take what they find: of a file that was cut they make a part of the body.

Source: 3D Systems, StereoLithography Interface Specification, 1989: a text of `facet` statements between `solid` and
`endsolid`, or 80 bytes, the number of facets, and 50 bytes for each of them.
"""

from __future__ import annotations

import re

_HEAD, _FACET = 84, 50
_NUMBER = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
_STATEMENTS = {
    "facet normal and three numbers, or endsolid": rb"facet\s+normal\s+\S+\s+\S+\s+\S+",  # of no area it may be nan
    "outer loop": rb"outer\s+loop",
    "vertex and three numbers": rb"vertex" + 3 * (rb"\s+" + _NUMBER),
    "a second vertex and three numbers": rb"vertex" + 3 * (rb"\s+" + _NUMBER),
    "a third vertex and three numbers": rb"vertex" + 3 * (rb"\s+" + _NUMBER),
    "endloop": rb"endloop",
    "endfacet": rb"endfacet",
}


def _pattern(text: bytes) -> re.Pattern[bytes]:
    return re.compile(rb"\s*" + text + rb"(?=\s|\Z)", re.IGNORECASE)


_WHOLE = _pattern(rb"\s+".join(_STATEMENTS.values()))
_EACH = {expected: _pattern(statement) for expected, statement in _STATEMENTS.items()}
_SOLID, _ENDSOLID = _pattern(rb"solid(?:[ \t][^\n]*)?"), _pattern(rb"endsolid(?:[ \t][^\n]*)?")


def stl_damage(content: bytes) -> str | None:
    """The damage of an STL file, with the line or the number of bytes; None where the file is whole."""
    facets, size = int.from_bytes(content[80:_HEAD], "little"), len(content)
    if size >= _HEAD and size == _HEAD + _FACET * facets:  # its head may begin with "solid" as well
        return None if facets else "it holds no facet"
    head = content[:1000].lower()
    if head.lstrip().startswith(b"solid") and (b"facet" in head or b"\0" not in head):
        return _text_damage(content)
    if size < _HEAD:
        return f"it ends at byte {size}, within the {_HEAD} bytes of its head"
    return f"{size} bytes, by the {facets} facets of its head {_HEAD + _FACET * facets}"


def _text_damage(text: bytes) -> str | None:
    solid, facets = _SOLID.match(text), 0
    if solid is None:
        return _unexpected(text, 0, "solid and a name")
    at = solid.end()
    while True:
        if (facet := _WHOLE.match(text, at)) is not None:
            at, facets = facet.end(), facets + 1
        elif (end := _ENDSOLID.match(text, at)) is not None:
            if (solid := _SOLID.match(text, end.end())) is None:
                break
            at = solid.end()
        else:
            for expected, statement in _EACH.items():
                if (found := statement.match(text, at)) is None:
                    return _unexpected(text, at, expected)
                at = found.end()
    if text[end.end() :].strip():
        return _unexpected(text, end.end(), "the end of the file")
    return None if facets else "it holds no facet"


def _unexpected(text: bytes, at: int, expected: str) -> str:
    at += len(text[at:]) - len(text[at:].lstrip())
    got = text[at : at + 40].partition(b"\n")[0].strip().decode("ascii", errors="replace")
    if not got:
        at = len(text.rstrip())
    line = text.count(b"\n", 0, at) + 1
    return f"line {line}: expected {expected}, got {got!r}" if got else f"line {line}: the file ends before {expected}"
