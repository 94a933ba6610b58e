"""A recorded bus set beside the plan of its scene."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from canprobe.bus.candump import read_candump
from canprobe.bus.port import ERR_FLAG, is_bus_error
from canprobe.errors import UsageError
from canprobe.planning import Plan, make_plan
from canprobe.planning.measured import MeasuredTraffic
from canprobe.planning.traffic_meter import TrafficMeter
from canprobe.scene import Scene
from canprobe.scene_resolve import resolve

LOG = "bus.log"


def measure_traffic(
    log: Path | str, scene: Scene | Plan, *, channel: str | None = None, exact: bool = True
) -> MeasuredTraffic:
    """Count what was on a bus and set it beside the plan, message by message.

    Args:
        log: a candump log, or the folder of a run.
        scene: the scene that ran, or its plan.
        channel: of the log; by default that of the scene's first bus, or the only one in the log.
        exact: count stuff bits too, which takes a few µs a frame.

    Returns:
        Frames and bits (stuff bits included) of every class of messages, their times behind SYNC, and the identifiers
        that the plan does not list.

    Raises:
        UsageError: the log cannot be read, has no SYNC on this channel, or several channels and none was named.
        PlanError: the scene does not fit its bus.
    """
    path = Path(log) / LOG if Path(log).is_dir() else Path(log)
    plan = scene if isinstance(scene, Plan) else make_plan(resolve(scene))
    meters: dict[str, TrafficMeter] = {}
    syncs: Counter[str] = Counter()
    for t_ns, name, can_id, data in read_candump(path):
        meter = meters.get(name)
        if meter is None:
            meter = meters[name] = TrafficMeter(plan, name, exact)
        if can_id & ERR_FLAG:
            meter.error_frames += is_bus_error(can_id)
        else:
            meter.write(can_id, data, t_ns)
            syncs[name] += can_id == 0x080
    return _chosen(path, meters, syncs, plan, channel).report()


def _chosen(
    path: Path, meters: dict[str, TrafficMeter], syncs: Counter[str], plan: Plan, channel: str | None
) -> TrafficMeter:
    with_sync = [name for name in meters if syncs[name]]
    wanted = plan.buses[0].channel if channel is None else channel
    if wanted in with_sync:
        return meters[wanted]
    if channel is None and len(with_sync) == 1:
        return meters[with_sync[0]]
    if not with_sync:
        raise UsageError(f"{path}: no SYNC (080h) on any channel; expected the log of a cell that ran")
    raise UsageError(
        f"{path}: no SYNC (080h) on channel {wanted}; name one that has it: {', '.join(sorted(with_sync))}"
    )
