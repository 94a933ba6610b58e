"""A recorded bus beside the plan of its scene."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.measured import MeasuredTraffic, TrafficMeter
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.clock_steps import RecordedBus
from canprobe.fieldbus.bus.port import ERR_FLAG, is_bus_error
from canprobe.fieldbus.protocol.frames import SYNC_ID, is_sync, long_syncs_text

LOG = "bus.log"


def measure_traffic(
    log: Path | str, scene: Scene | Plan | str | Path, *, channel: str | None = None, exact: bool = True
) -> MeasuredTraffic:
    """Count the frames of a bus and compare them with the plan, message by message.

    Args:
        log: a candump log, or the folder of a run.
        scene: the scene that ran, as for `canprobe.run`, or its plan.
        channel: channel of the log; by default that of the scene's first bus, or the only one in the log.
        exact: whether to count stuff bits, which takes a few µs per frame.

    Returns:
        Frames and bits (stuff bits included) of every class of messages, their times behind SYNC, and the identifiers
        that the plan does not list.

    Raises:
        UsageError: when the log cannot be read, has no SYNC on this channel, or has several channels and none is named.
        PlanError: when the scene does not fit its bus.
    """
    path = Path(log) / LOG if Path(log).is_dir() else Path(log)
    if path != Path(log) and not path.exists():
        raise UsageError(
            f"{log}: no {LOG} in this folder; expected that of a run on a bus, with outputs.bus_log = true"
        )
    plan = scene if isinstance(scene, Plan) else make_plan(resolve(load_scene(scene)))
    meters: dict[str, TrafficMeter] = {}
    syncs: Counter[str] = Counter()
    long_syncs: Counter[int] = Counter()
    bus = RecordedBus(path)
    for t_ns, name, can_id, data in bus:
        meter = meters.get(name)
        if meter is None:
            meter = meters[name] = TrafficMeter(plan, name, exact)
        if can_id & ERR_FLAG:
            meter.error_frames += is_bus_error(can_id)
        else:
            meter.write(can_id, data, t_ns)
            syncs[name] += is_sync(can_id, data)
            long_syncs[len(data)] += can_id == SYNC_ID and not is_sync(can_id, data)
    longer = long_syncs_text(+long_syncs)
    name = _chosen(path, syncs, longer, plan, channel)
    measured = meters[name].report()
    return replace(
        measured,
        unlisted=measured.unlisted | ({SYNC_ID: long_syncs.total()} if longer else {}),
        notes=(*([longer] if longer else []), *bus.notes()),
        xl_frames=bus.xl.get(name, 0),
        lost_by_candump=bus.lost.get(name, 0),
    )


def _chosen(path: Path, syncs: Counter[str], longer: str, plan: Plan, channel: str | None) -> str:
    with_sync = [name for name in syncs if syncs[name]]
    wanted = plan.buses[0].channel if channel is None else channel
    if wanted in with_sync:
        return wanted
    if channel is None and len(with_sync) == 1:
        return with_sync[0]
    if not with_sync:
        but = f" of 0 or 1 byte, but {longer}" if longer else " on any channel"
        raise UsageError(f"{path}: no SYNC (080h){but}; expected the log of a cell that ran")
    raise UsageError(
        f"{path}: no SYNC (080h) on channel {wanted}; name one that has it: {', '.join(sorted(with_sync))}"
    )
