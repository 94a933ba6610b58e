"""Files of another kind than the EDS file or the candump log that was expected, known by their first bytes."""

from __future__ import annotations

from typing import NamedTuple

HEAD_BYTES = 64
"""Length of the beginning by which a file is known."""


class FileKind(NamedTuple):
    """What a file is by its first bytes, and what to type to make a candump log or an EDS file of it; empty: nothing.

    Attributes:
        name: its kind, in words.
        into_log, into_eds: command with ``{path}``, or advice.
    """

    name: str
    into_log: str = ""
    into_eds: str = ""


_TSHARK = (
    "type: tshark -r {path} -Y can.id -T fields -E separator=, -e frame.time_epoch -e can.id -e can.flags.xtd"
    ' -e can.flags.rtr -e data.data | awk -F, \'{{printf "(%.6f) can0 " ($3 ~ /1|T/ ? "%08X" : "%03X") "#%s\\n",'
    ' $1, $2, $4 ~ /1|T/ ? "R" : (length($5) > 16 ? "#1" : "") toupper($5)}}\' > bus.log'
)
_CONVERT = "type: can_logconvert {path} bus.log"
_PCAP = FileKind("a capture of tcpdump or Wireshark (pcap)", _TSHARK)
XML = FileKind("XML, as XDD and XDC files are")


def _packed(by: str, unpack: str) -> FileKind:
    return FileKind(
        f"compressed by {by}", f"type: {unpack} {{path}} > bus.log", f"type: {unpack} {{path}} > device.eds"
    )


_KINDS = {
    b"\x1f\x8b": _packed("gzip", "zcat <"),
    b"BZh": _packed("bzip2", "bzcat <"),
    b"\xfd7zXZ": _packed("xz", "xzcat <"),
    b"\x28\xb5\x2f\xfd": _packed("zstd", "zstdcat <"),
    b"PK\3\4": _packed("zip", "unzip -p"),
    b"\xd4\xc3\xb2\xa1": _PCAP,
    b"\xa1\xb2\xc3\xd4": _PCAP,
    b"\x4d\x3c\xb2\xa1": _PCAP,
    b"\xa1\xb2\x3c\x4d": _PCAP,
    b"\n\r\r\n": FileKind("a capture of Wireshark (pcapng)", _TSHARK),
    b"LOGG": FileKind("a log of Vector's tools (BLF)", _CONVERT),
    b"MDF ": FileKind("a measurement of ASAM MDF", _CONVERT),
    b"<?xml": XML,
    b"<ISO15745": XML,
}
"""Kinds of files by their first bytes. Source: file(1), magic; pcap-savefile(5); CiA 311."""


def file_kind(head: bytes) -> FileKind | None:
    """Kind of a file that is neither a candump log nor an EDS file, by its first bytes; None for any other."""
    text = head.replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \t\r\n")  # a mark of UTF-8 or UTF-16, and blanks
    return next(
        (kind for magic, kind in _KINDS.items() if head.startswith(magic) or (kind is XML and text.startswith(magic))),
        None,
    )
