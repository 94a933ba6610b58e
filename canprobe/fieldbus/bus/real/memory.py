"""Keeps page faults and the garbage collector out of cycles."""

from __future__ import annotations

import contextlib
import functools
import gc
from collections.abc import Iterator

BYTES_PER_CYCLE = 4 << 10
"""A cycle that keeps its frames, log rows and truth grows by 1 to 3 KiB."""
MIN_RESERVE_BYTES, MAX_RESERVE_BYTES = 4 << 20, 32 << 20
"""Bytes that are taken in advance; a run of 20 s at 400 Hz grows by less."""
_SMALL_OBJECT_BYTES = 480  # bytes; objects up to 512 come from Python's own allocator, larger ones from the C library
_KEPT_STRIDE = (256 << 10) // 512


@functools.cache
def reserve_memory(cycles: int) -> tuple[bytes, ...]:
    """Let both allocators take memory from the system now, and keep it.

    The first touch of a page costs a microsecond, and a hundred in a virtual machine that has to ask its host, which
    makes a second for the largest reserve.

    Args:
        cycles: number of cycles that will keep data; a longer run takes the rest on the way.

    Returns:
        Objects that hold the memory until the process ends; a second call does nothing.
    """
    # half for small objects, half for large ones
    size = min(MIN_RESERVE_BYTES + cycles * BYTES_PER_CYCLE, MAX_RESERVE_BYTES)
    blocks = [bytes(_SMALL_OBJECT_BYTES) for _ in range(size // 2 // 512)]
    for _ in range(2):  # the first raises glibc's limits above this size, the second then comes out of its heap
        bytearray(size // 2)
    return tuple(blocks[::_KEPT_STRIDE])  # an arena with nothing in it would go back to the system


@contextlib.contextmanager
def garbage_collection_paused(*, collect: bool = True) -> Iterator[None]:
    """Pause the garbage collector within the block: a full collection takes 35 ms with these libraries, 14 cycles.

    Objects that exist at its start are set aside, so that a collection afterwards is short. The cycle makes no
    reference cycles, so no garbage gathers meanwhile.

    Args:
        collect: whether to collect once before the block; False where a later collection costs nothing.
    """
    was_enabled = gc.isenabled()
    if collect:
        gc.collect()
        gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        if collect:
            gc.unfreeze()
        if was_enabled:
            gc.enable()
