"""How four makers put images into raw frames, written from their drivers."""

from canprobe.fieldbus.protocol.raw_image import FramePattern, ImageFormat


def _format(first, last, frames, rows, columns, *, byte_order="big", axes=1, by_columns=False):
    patterns = tuple(FramePattern.parse(text, byte_order) for text in frames)
    return ImageFormat(tuple(range(first, last + 1)), patterns, rows, columns, axes, by_columns)


FORMATS = {
    "icub-triangles": _format(0x4D0, 0x4D1, ("40 tt uu vv ww xx yy ..", "C0 tt uu vv .. ww .. .."), 2, 10),
    "linker12x6": _format(0x027, 0x027, [f"B1 {row:X}0 uu vv ww xx yy zz" for row in range(12)], 12, 6),
    "poweron6x6": _format(0x300, 0x30B, ("tt uu vv ut .v",), 6, 6, byte_order="little"),
    "uskin4x4": _format(0x710, 0x71F, (".. xxxx yyyy zzzz",), 4, 4, axes=3, by_columns=True),
    "uskin4x6": _format(0x710, 0x727, (".. xxxx yyyy zzzz",), 4, 6, axes=3, by_columns=True),
}
