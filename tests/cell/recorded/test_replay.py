"""Replay: the folder of a run gives the online result again, and any log of the same nodes gives a shape."""

from __future__ import annotations

import json
import random
import re

import numpy as np
from candump_lines import can_id_of, restamped, stamp_us

import canprobe
from canprobe.cell.npz import read_npz
from canprobe.cell.recorded.recording import RunFolder
from canprobe.cli import main
from canprobe.fieldbus.bus.candump import read_candump

DRIVES = tuple(f"{0x180 + node:03X}" for node in range(1, 7))
TRUE_KAPPA = np.array([1 / 0.036, 0.0])


def assert_same(records, online, shift_ns=0):
    """Number by number, to the last bit; the times to the nanosecond."""
    assert len(records) == len(online) >= 20
    for a, b in zip(records, online, strict=True):
        assert (round((a.t_s - b.t_s) * 1e9), a.travelled_m) == (shift_ns, b.travelled_m)
        np.testing.assert_array_equal(a.estimate.K, b.estimate.K)
        np.testing.assert_array_equal(a.estimate.covariance, b.estimate.covariance)
        np.testing.assert_array_equal(a.estimate.T_frame_contact, b.estimate.T_frame_contact)


def settled(records):
    """Times, curvature tensors in base (n, 3, 3), and what deviation is stated of the estimates after 10 mm."""
    late = [r for r in records if r.travelled_m > 0.010]
    variances = [np.diag(r.estimate.covariance) @ (1.0, 2.0, 1.0) for r in late]  # of K11, √2 K12, K22
    tensors = np.array([r.estimate.curvature_tensor_base() for r in late])
    return np.array([r.t_s for r in late]), tensors, np.sqrt(variances)


def largest_deviation(records, reference):
    """Of the curvature, at the reference's instants, in the deviations that it states.

    The reference's last estimate may be before the replay's first or last.
    """
    times, K, _ = settled(records)
    t_ref, K_ref, sigma = settled(reference)
    nearest = np.abs(times[:, None] - t_ref).argmin(axis=0)
    near = np.abs(times[nearest] - t_ref) < 0.021  # half of the time between two estimates
    assert np.count_nonzero(~near) <= 1 and len(near) > 10
    return float((np.linalg.norm(K[nearest] - K_ref, axis=(1, 2)) / sigma)[near].max())


def test_the_folder_of_a_run_gives_the_online_result_to_the_last_bit(lockstep_run):
    result = canprobe.replay(lockstep_run.out)
    assert result.summary["driven_by"] == "task"
    assert_same(result.estimates["recursive"], lockstep_run.estimates["recursive"])
    online = json.loads((lockstep_run.out / "summary.json").read_text())
    assert json.loads(json.dumps(result.summary["shape"])) == online["shape"]
    assert "the scene's task drove: its scan is replayed\n" in result.text()
    assert result.summary["online"]["K_max_difference_per_m"] == 0.0
    assert result.summary["online"]["replayed"] == result.summary["online"]["estimates"] >= 20


def test_the_cycles_of_a_run_have_the_times_that_its_estimates_were_dated_by(tmp_path):
    """A rounding error more, and an estimate is scored against the truth of the cycle beside it."""
    times_ns = np.arange(8000, dtype=np.int64) * 2_500_000
    run = RunFolder(tmp_path, {"t_s": 0.4671 + times_ns * 1e-9}, {})
    assert np.any(run.log["t_s"] - run.start_s != times_ns * 1e-9)
    np.testing.assert_array_equal(run.times_s, times_ns * 1e-9)


def test_all_files_of_a_run_count_from_the_instant_that_is_0_in_its_bus_log(lockstep_run):
    folder = lockstep_run.out
    frames = [(t_ns * 1e-9, can_id) for t_ns, _, can_id, _ in read_candump(folder / "bus.log")]
    syncs = np.array([t_s for t_s, can_id in frames if can_id == 0x080])
    log, truth = read_npz(folder / "log.npz"), read_npz(folder / "truth.npz")
    assert frames[0][0] < 0.01 and syncs[0] > 0.3  # bring-up is before the first cycle
    np.testing.assert_allclose(truth["t_s"], syncs, rtol=0, atol=1e-6)  # candump cuts off below the microsecond
    wire = syncs[: len(log["t_s"])] - log["t_s"]
    assert wire.min() > 0 and wire.max() < 200e-6  # the frame, and one that was under way at the deadline
    answers = lockstep_run.estimates["recursive"]
    told = np.array([record.reported_s for record in answers])
    rows = [int(np.abs(log["t_s"] - t_s).argmin()) for t_s in told]
    np.testing.assert_allclose(log["t_s"][rows], told, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(log["K_per_m"][rows], [record.estimate.K for record in answers])
    taken = np.array([record.t_s for record in answers])
    assert ((told - 0.1 < taken) & (taken < told)).all()


def test_a_log_whose_lines_are_in_another_order_is_sorted_by_its_stamps(lockstep_run, replayed_log, copy_of):
    def later(lines):
        rng = random.Random(1)
        shift = {stamp_us(line): rng.randrange(4000) for line in lines}
        return sorted(lines, key=lambda line: stamp_us(line) + shift[stamp_us(line)])

    sorted_again = canprobe.replay(copy_of(lockstep_run.out, later))
    assert_same(sorted_again.estimates["recursive"], replayed_log.estimates["recursive"])


def test_a_bus_with_delays_and_overruns_is_replayed_to_the_last_bit(delayed_run):
    folder, task, cell = delayed_run
    assert cell.cycle.statistics.overruns > 3 and cell.drives.missed > 0 and cell.drives.late > 0
    result = canprobe.replay(folder)
    assert result.summary["driven_by"] == "task"
    assert_same(result.tracker.records, task.shape.records)
    assert_same(result.estimates["recursive"], task.shape.records, cell.cycles.start_ns)


def test_lost_lines_are_counted_and_cost_little(motion_run, copy_of):
    """Of the drives, of the array, and SYNCs, which are known from the counter."""
    lost = {"tpdo": 0, "taxels": 0, "sync": 0}

    def drop(lines):
        rng = random.Random(3)
        syncs, middle = 0, len(lines) * 4 // 5
        for i, line in enumerate(lines):
            can_id = can_id_of(line)
            syncs += can_id == "080"
            if can_id in DRIVES and rng.random() < 0.01:
                lost["tpdo"] += 1
            elif can_id == "514" and i > middle and not lost["taxels"]:
                lost["taxels"] += 1
            elif can_id == "080" and syncs % 97 == 0:
                lost["sync"] += 1
            else:
                yield line

    result = canprobe.replay(copy_of(motion_run.out, drop))
    cycle = result.summary["cycle"]
    assert lost["tpdo"] > 10 and cycle["missed_pdos"] <= lost["tpdo"] < cycle["missed_pdos"] + 5  # a few at the end
    assert cycle["torn_frames"] == cycle["lost_frames"] == lost["taxels"] == 1
    assert lost["sync"] - 1 <= cycle["lost_syncs"] <= lost["sync"]
    assert result.summary["shape"]["position_rms_mm"] < 0.15  # against the truth's row of the right SYNC
    assert largest_deviation(result.estimates["recursive"], motion_run.estimates["recursive"]) < 1.6


def test_a_sync_without_a_counter_places_the_frames_by_their_arrival(lockstep_run, replayed_log, copy_of):
    def bare(lines):
        return [re.sub(r" 080#..$", " 080#", line) for line in lines]

    without = canprobe.replay(copy_of(lockstep_run.out, bare))
    assert_same(without.estimates["recursive"], replayed_log.estimates["recursive"])


def test_a_log_of_another_pace_channel_and_epoch_gives_the_shape(lockstep_run, tmp_path):
    """No counter, another channel beside it, error frames, remote requests, other nodes: none of it disturbs."""
    lines = []
    for recorded in (lockstep_run.out / "bus.log").read_text().splitlines():
        line = restamped(recorded, 1_700_000_000_123_456 + stamp_us(recorded) * 26 // 25).replace(
            " can0 ", " can_left "
        )
        lines.append(re.sub(r" 080#..$", " 080#", line))
        if can_id_of(line) == "080":
            lines.append(restamped(f"() can_right {can_id_of(line)}#", stamp_us(line)))
        if can_id_of(line) == "181" and len(lines) % 40 == 0:
            lines += [restamped(f"() can_left {frame}", stamp_us(line)) for frame in ("20000088#00", "701#R", "3A0#01")]
    log = tmp_path / "other.log"
    log.write_text("\n".join(lines) + "\n")
    result = canprobe.replay(log, scene="cylinder", method=("recursive", "ml"))
    summary = result.summary
    assert (summary["driven_by"], summary["channel"]) == ("other", "can_left")
    assert summary["cycle"]["error_frames"] > 10 and summary["cycle"]["torn_frames"] == 0
    for records in result.estimates.values():
        np.testing.assert_allclose(records[-1].estimate.kappa, TRUE_KAPPA, atol=0.1 * TRUE_KAPPA[0])


def test_a_run_of_another_length_parts_from_the_scenes_task(lockstep_run):
    result = canprobe.replay(lockstep_run.out, scene="cylinder", method="recursive")  # which scans for 20 s
    assert result.summary["driven_by"] == "other" and result.summary["online"] is None
    assert len(result.tracker.samples) > 200
    np.testing.assert_allclose(result.estimates["recursive"][-1].estimate.kappa, TRUE_KAPPA, atol=2.0)


def test_other_methods_get_the_same_contacts(lockstep_run, tmp_path):
    result = canprobe.replay(lockstep_run.out, method=["chen1996", "chord", "ml"])
    assert list(result.estimates) == ["chen1996", "chord", "ml"]
    assert result.summary["shape"]["method"] == "chen1996"
    assert set(result.summary["shape"]["methods"]) == {"chen1996", "chord", "ml"}
    for records in result.estimates.values():
        assert records[-1].t_s <= lockstep_run.log["t_s"][-1]
        np.testing.assert_allclose(records[-1].estimate.kappa, TRUE_KAPPA, atol=0.2 * TRUE_KAPPA[0])
    result.save(tmp_path / "estimates.npz")
    with np.load(tmp_path / "estimates.npz") as saved:
        np.testing.assert_array_equal(saved["ml_K_per_m"][-1], result.estimates["ml"][-1].estimate.K)
        assert saved["chord_T_base_contact_m"].shape[1:] == (4, 4)


def test_the_command(lockstep_run, tmp_path, capsys):
    out = tmp_path / "estimates.npz"
    assert main(["replay", str(lockstep_run.out), "--method", "recursive", "--json", "--out", str(out)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["online"]["K_max_difference_per_m"] == 0.0
    assert document["shape"]["method"] == "recursive" and out.is_file()
