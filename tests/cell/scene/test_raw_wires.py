"""The packaged arrays of raw frames state the formats of their makers."""

from raw_formats import FORMATS

from canprobe.cell.scene.load import load_array, packaged
from canprobe.cell.scene.model import WireSettings
from canprobe.cell.scene.rules import image_format


def format_of(file):
    wire = WireSettings(**{key: tuple(v) if isinstance(v, list) else v for key, v in file["wire"].items()})
    return image_format(wire, file["sensor"]["rows"], file["sensor"]["columns"])


def test_every_packaged_array_of_raw_frames_has_the_format_of_its_maker():
    files = {name: load_array(name) for name, _ in packaged("array")}
    raw = {name: format_of(file) for name, file in files.items() if file["wire"]["kind"] == "frames"}
    assert raw == FORMATS
