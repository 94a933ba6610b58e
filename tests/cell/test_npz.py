"""Files of a run that are cut off, empty or something else: one line that names the file, from every reader."""

import bz2
import io
import lzma
import pickle
import re
import struct
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest

import canprobe
from canprobe.cell.npz import MAX_UNPACKED_BYTES, read_npz, write_npz
from canprobe.errors import UsageError


def npz(**columns):
    held = io.BytesIO()
    np.savez_compressed(held, **columns)
    return held.getvalue()


def npy(values):
    held = io.BytesIO()
    np.save(held, values)
    return held.getvalue()


WHOLE = npz(t_s=np.arange(3.0))


DAMAGED = {"empty": b"", "cut off": WHOLE[:-9], "torn": b"PK", "text": b"t_s\n0\n", "single array": npy(np.arange(3.0))}


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
@pytest.mark.parametrize(("read", "what"), [(read_npz, "an .npz of a run"), (canprobe.load_table, "the log of a run")])
def test_a_damaged_file_is_named(content, read, what, tmp_path):
    (tmp_path / "log.npz").write_bytes(content)
    with pytest.raises(UsageError, match=rf"log\.npz: expected {re.escape(what)}; cannot be read: "):
        read(tmp_path / "log.npz")


def test_a_whole_one_is_read(tmp_path):
    (tmp_path / "log.npz").write_bytes(WHOLE)
    assert read_npz(tmp_path / "log.npz")["t_s"].tolist() == [0.0, 1.0, 2.0]


def test_a_column_is_read_alone_and_only_a_damaged_one_cannot(tmp_path):
    """The file may be replaced meanwhile, as by another run into the same folder."""
    file, times, noise = tmp_path / "log.npz", np.arange(9e4), np.random.default_rng(1).bytes(80_000)
    write_npz(file, {"t_s": times, "force_n": np.frombuffer(noise, np.uint8), "empty": np.empty((0, 2))})
    assert file.stat().st_size < 300_000
    with np.load(file) as whole:
        np.testing.assert_array_equal(whole["t_s"], times)
    content = bytearray(file.read_bytes())
    content[-9_000:-8_996] = b"oops"
    sound = read_npz(file)
    write_npz(file, {"t_s": times[:3]})
    tracemalloc.start()
    try:
        assert sound.heads["force_n"].shape == (80_000,) and sound["empty"].shape == (0, 2)
        assert tracemalloc.get_traced_memory()[1] < 64_000
    finally:
        tracemalloc.stop()
    sound["t_s"][:] *= 2.0
    np.testing.assert_array_equal(sound["t_s"], 2.0 * times)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(sound))["force_n"], np.frombuffer(noise, np.uint8))
    file.write_bytes(content)
    damaged = read_npz(file)
    np.testing.assert_array_equal(damaged["t_s"], times)
    with pytest.raises(UsageError, match=r"log\.npz: expected an \.npz of a run; force_n\.npy cannot be read: "):
        damaged["force_n"]


# Files that unpack to far more than their size.


MILLION_ZEROS = bytes(8_000_000)


def zipped(stream, size, *, crc=0, method=zipfile.ZIP_DEFLATED, name=b"t_s.npy"):
    """A zip file with one entry, whose headers say this of it."""
    fields = struct.pack("<HHHHHIIIHH", 20, 0, method, 0, 0, crc, len(stream), size, len(name), 0)
    head = b"PK\x03\x04" + fields + name
    directory = b"PK\x01\x02" + struct.pack("<H", 20) + fields + struct.pack("<HHHII", 0, 0, 0, 0, 0) + name
    place = len(head) + len(stream)
    return head + stream + directory + b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, 1, 1, len(directory), place, 0)


def array_header(count):
    held = io.BytesIO()
    np.lib.format.write_array_header_1_0(held, {"descr": "<f8", "fortran_order": False, "shape": (count,)})
    return held.getvalue()


def bomb(millions=400, *, size=None, shape=None, crc=0, name=b"t_s.npy"):
    """One array of zeros, 3 MB that unpack to 3.2 GB; headers may say other sizes."""
    packed = zlib.compressobj(9, zlib.DEFLATED, -15)
    header = array_header(1_000_000 * millions if shape is None else shape)
    stream = packed.compress(header) + packed.flush(zlib.Z_FULL_FLUSH)
    stream += (packed.compress(MILLION_ZEROS) + packed.flush(zlib.Z_FULL_FLUSH)) * millions + packed.flush()
    return zipped(stream, len(header) + len(MILLION_ZEROS) * millions if size is None else size, crc=crc, name=name)


def other_compression(compress, method):
    content = array_header(1_000_000) + MILLION_ZEROS
    return zipped(compress(content), len(content), crc=zlib.crc32(content), method=method)


def of_many(count, size):
    """Arrays that are each small by the directory, and many."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as saved:
        for number in range(count):
            saved.writestr(f"a{number}.npy", npy(np.zeros(1)))
            saved.filelist[-1].file_size = size
    return held.getvalue()


def with_header(text):
    """An array whose header is so long, and small otherwise."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as saved:
        saved.writestr("t_s.npy", b"\x93NUMPY\x02\x00" + struct.pack("<I", len(text)) + text)
    return held.getvalue()


ONE = array_header(1) + bytes(8)
MOST = rf"it unpacks to \d+ bytes, expected {MAX_UNPACKED_BYTES} at most"
BOMBS = {
    "3.2 GB": (bomb, "it unpacks to 3200000128 bytes, expected 1073741824 at most"),
    "many arrays": (lambda: of_many(140, 8_000_128), r"no array of shape \(1,\)"),
    "a directory that says more": (lambda: zipped(b"", 3_200_000_128), "EOF"),
    "a directory that says less": (lambda: bomb(40, size=5000), r"no array of shape \(40000000,\)"),
    "an array that says less": (lambda: bomb(40, shape=1), r"no array of shape \(1,\)"),
    "bzip2": (lambda: other_compression(bz2.compress, zipfile.ZIP_BZIP2), "compressed in another way"),
    "lzma": (lambda: other_compression(lzma.compress, zipfile.ZIP_LZMA), "compressed in another way"),
    "a long header": (lambda: with_header(b" " * 20_000_000), "Header info length"),
    "objects": (lambda: npz(t_s=np.array([1, [2, [3]]], dtype=object)), "holds Python objects"),
    "objects in fields": (lambda: npz(t_s=np.zeros(2, [("a", "f8"), ("b", "O")])), "holds Python objects"),
}


@pytest.mark.parametrize(("make", "why"), BOMBS.values(), ids=BOMBS)
def test_what_unpacks_to_too_much_is_refused_before_it_is_unpacked(make, why, tmp_path):
    (tmp_path / "log.npz").write_bytes(make())
    tracemalloc.start()
    try:
        with pytest.raises(UsageError, match=rf"log\.npz: expected an \.npz of a run; .*cannot be read: .*{why}"):
            dict(read_npz(tmp_path / "log.npz"))
        assert tracemalloc.get_traced_memory()[1] < 64_000_000
    finally:
        tracemalloc.stop()


def test_no_more_is_unpacked_than_headers_and_directory_say(tmp_path):
    """320 MB behind an array of one number: all headers agree, and are a lie."""
    (tmp_path / "log.npz").write_bytes(bomb(40, size=len(ONE), shape=1, crc=zlib.crc32(ONE)))
    tracemalloc.start()
    try:
        assert read_npz(tmp_path / "log.npz")["t_s"].tolist() == [0.0]
        assert tracemalloc.get_traced_memory()[1] < 8_000_000
    finally:
        tracemalloc.stop()


def test_heights_of_a_scene_that_unpack_to_too_much_are_refused(tmp_path):
    """Whatever the file calls itself."""
    for name in ("relief.npz", "relief.npy"):
        (tmp_path / name).write_bytes(bomb(name=b"heights.npy"))
        with pytest.raises(UsageError, match=rf"{name} is no grid of numbers: heights.npy cannot be read: {MOST}"):
            canprobe.plan("relief", {"object.file": str(tmp_path / name)})
