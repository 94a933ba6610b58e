"""The bounded queue: whole records or none, counted losses, and a writer that never waits longer than it said."""

from __future__ import annotations

import io
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.lab.bridge import pipe as feed_module
from canprobe.lab.bridge.pipe import Feed, read_records


@pytest.fixture
def pipe():
    reader, writer = os.pipe()
    os.set_blocking(reader, False)
    yield reader, writer
    os.close(reader)


def drained(reader):
    data = b""
    try:
        while chunk := os.read(reader, 1 << 20):
            data += chunk
    except BlockingIOError:
        pass
    return data


def test_records_arrive_in_batches_and_in_order(pipe):
    reader, writer = pipe
    feed = Feed(writer, batch=3)
    for i in range(7):
        feed.put(bytes([i]) * i)
    assert list(read_records(io.BytesIO(drained(reader)))) == [bytes([i]) * i for i in range(6)]
    feed.flush()
    assert list(read_records(io.BytesIO(drained(reader)))) == [b"\x06" * 6]
    assert (feed.taken, feed.dropped) == (7, 0)
    feed.close()


def test_a_full_queue_drops_whole_records_and_counts_each(pipe):
    """Nobody reads for a while: what fits stays, in order; what does not is counted; then it goes on."""
    reader, writer = pipe
    feed = Feed(writer, batch=4)
    records = [i.to_bytes(2, "big") * 3000 for i in range(400)]  # 2.4 MB, above any pipe's buffer
    for record in records:
        feed.put(record)
    dropped = feed.dropped
    data = drained(reader)
    feed.flush()
    data += drained(reader)
    got = list(read_records(io.BytesIO(data)))
    assert 0 < dropped < 400 and len(got) == 400 - dropped
    assert got == records[: len(got)]
    for record in records[:8]:
        feed.put(record)
    assert list(read_records(io.BytesIO(drained(reader)))) == records[:8]
    assert feed.dropped == dropped
    feed.close()


def test_a_reader_that_is_gone_costs_samples_only(pipe):
    _, writer = pipe
    other, gone = os.pipe()
    os.dup2(gone, writer)
    os.close(gone)
    os.close(other)
    feed = Feed(writer, batch=2)
    for _ in range(10):
        feed.put(b"x")
    assert feed.broken and (feed.taken, feed.dropped) == (10, 10)
    feed.close()
    feed.close()


def test_a_lossless_feed_waits_once_for_a_reader_that_stands_still(pipe, monkeypatch):
    waits = []
    monkeypatch.setattr(feed_module.select, "select", lambda r, w, x, t: (waits.append(t), ([], [], []))[1])
    feed = Feed(pipe[1], batch=1, lossless=True)
    for _ in range(1000):
        feed.put(b"x" * 5000)
    assert waits == [feed_module.PATIENCE_S] and feed.dropped > 0
    feed.close()


@given(st.lists(st.binary(max_size=50), max_size=10), st.integers(0, 60))
def test_a_torn_record_at_the_end_is_left_out(records, cut):
    stream = b"".join(len(r).to_bytes(4, "little") + r for r in records)
    whole = list(read_records(io.BytesIO(stream[: max(0, len(stream) - cut)])))
    assert whole == records[: len(whole)]
    assert cut or whole == records
