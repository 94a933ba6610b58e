"""No frame, however broken, makes a node raise, grow, fall silent or enter a state that the tables do not have.

Plain random and mutated frames (seeds are printed on failure), and hypothesis, which shrinks what it finds. The suite
runs some ten thousand; `--benchmark-only -k million` runs the million.
"""

from __future__ import annotations

import resource
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from node_fuzz import COMMANDS, GUARD, Watched, rage

from canprobe.fieldbus import load_eds
from canprobe.fieldbus.drive import make_drive_node


def make_node(kind, make_bench, plant):
    if kind == "tiny":
        return make_bench().node
    return make_drive_node(load_eds("puma260_joint", 5), 5, 0, plant)


@pytest.mark.parametrize("kind", ["tiny", "drive"])
def test_random_and_mutated_frames(kind, make_bench, plant):
    rage(Watched(make_node(kind, make_bench, plant)), 30_000, seed=20260)


_requests = st.builds(
    lambda command, index, subindex, tail: (0x605, bytes((command, index & 0xFF, index >> 8, subindex)) + tail),
    st.one_of(st.sampled_from(COMMANDS), st.integers(0, 255)),
    st.sampled_from([0x1000, 0x1008, 0x1010, 0x1016, 0x1017, 0x1029, 0x1400, 0x1800, 0x1A00, 0x2000, 0x2001, 0x2004]),
    st.integers(0, 3),
    st.one_of(st.binary(min_size=4, max_size=4), st.sampled_from([b"\x05\0\0\0", b"save", b"\xfa\0\x7f\0"])),
)
_others = st.tuples(
    st.sampled_from([0x000, 0x080, 0x205, 0x605, 0x77F, GUARD, 0x40000185, 0x7FF]), st.binary(max_size=8)
)
_frames = st.lists(st.tuples(st.one_of(_requests, _others), st.sampled_from([0, 10**6, 10**9])), max_size=40)


def test_frames_that_hypothesis_finds(make_bench):
    @settings(max_examples=150)
    @given(_frames)
    def check(frames):
        watched = Watched(make_bench().node)
        for (can_id, data), wait_ns in frames:
            watched.feed(can_id, data, wait_ns)
        watched.check_end()

    check()


@pytest.mark.slow(reason="a million frames; with --benchmark-only")
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("kind", ["tiny", "drive"])
def test_a_million_frames(benchmark, kind, make_bench, plant):
    """Run with --benchmark-only. Memory after the first tenth may not grow by more than its transfers can hold."""
    watched = Watched(make_node(kind, make_bench, plant))
    benchmark.pedantic(rage, (watched, 100_000, 1), rounds=1)
    before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in range(2, 11):
        rage(watched, 100_000, seed)
    grown_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib
    benchmark.extra_info["grown_kib"] = grown_kib
    print(f"{kind}: grown by {grown_kib} KiB, {watched.size()}", file=sys.stderr)
    assert grown_kib < 16 << 10
