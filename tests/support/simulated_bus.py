"""A bus in thirty lines, to hold the analysis against: non-preemptive, the lowest identifier first, no error."""

from __future__ import annotations

import itertools


def simulate(messages, releases):
    """Non-preemptive bus, lowest identifier first: longest response per message. Releases: (queued, event, rank)."""
    pending, worst, now = sorted(releases), dict.fromkeys(range(len(messages)), 0), -(10**9)
    queue = []
    while pending or queue:
        if not queue:
            now = max(now, pending[0][0])
        while pending and pending[0][0] <= now:
            queued, event, rank = pending.pop(0)
            queue.append((rank, queued, event))
        queue.sort()
        rank, _, event = queue.pop(0)
        now += messages[rank].frame_ns
        worst[rank] = max(worst[rank], now - event)
    return worst


def instants(message, rank, first, until, queued_from=None):
    for k in itertools.count():
        event = first + k * message.period_ns
        if event > until:
            return
        yield (event if queued_from is None else max(event, queued_from), event, rank)
