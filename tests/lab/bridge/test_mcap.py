"""The MCAP file of a run, read back by a reader of its own and held against what the run wrote elsewhere."""

from __future__ import annotations

import json

import cantools
import numpy as np
import pytest
from full_disk import room_for
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import canprobe
from canprobe.cell.recorded.reestimate import replay_into
from canprobe.cli import main
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.eds.packaged import eds_path
from canprobe.lab.bridge.messages import Encoder, Messages
from canprobe.lab.bridge.sample import Sample
from canprobe.lab.bridge.view.recorded import read_run
from canprobe.mechanics.robot.chain import forward

RADIUS = 0.036


def messages_of(path):
    """(topic, log time, CDR) of every message, by mcap's reader."""
    with path.open("rb") as file:
        return [(c.topic, m.log_time, m.data) for _, c, m in make_reader(file).iter_messages()]


@pytest.fixture(scope="module")
def decoded(recorded):
    """Topic → [(log time, message)], by mcap's reader and its ROS 2 decoder, which knows nothing of rosbags."""
    found = {}
    with (recorded.folder / "run.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, ros in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, ros))
    return found


def test_profile_encodings_and_attachments(recorded):
    with (recorded.folder / "run.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        attachments = {a.name: a.data for a in reader.iter_attachments()}
        assert reader.get_header().profile == "ros2"
    assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
    assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
    assert all("reliability:" in c.metadata["offered_qos_profiles"] for c in summary.channels.values())
    assert attachments["scene.toml"] == (recorded.folder / "scene.toml").read_bytes()
    for eds in ("puma260_joint.eds", "tactile_array.eds"):
        assert attachments[eds] == eds_path(eds).read_bytes()
    frames = {
        message.frame_id
        for message in cantools.database.load_string(attachments["cylinder.dbc"].decode("cp1252")).messages
    }
    assert {pdo.cob_id for pdo in recorded.result.plan.pdos} <= frames
    assert json.loads(attachments["summary.json"]) == json.loads((recorded.folder / "summary.json").read_text())
    assert not (recorded.folder / "run.mcap.part").exists()


def test_nothing_is_dropped_in_lockstep_and_the_summary_says_so(recorded):
    where = str(recorded.folder / "run.mcap")
    status = {"samples": len(recorded.observations), "dropped": 0, "where": where, "error": None}
    assert recorded.result.summary["bridges"]["mcap"] == status
    assert "bridge     mcap:" in recorded.result.text()
    assert recorded.result.summary["cycle"]["observe_us"]["p50"] > 0


def test_joint_states_are_the_logged_joints(recorded, decoded):
    q, t = recorded.log("q_rad"), recorded.log("t_s")
    known = np.isfinite(q).all(axis=1)
    rows = decoded["/joint_states"]
    assert [time for time, _ in rows] == [round(s * 1e9) for s in t[known]]
    np.testing.assert_array_equal([ros.position for _, ros in rows], q[known])
    time, ros = rows[-1]
    assert ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec == time
    assert ros.name == [f"joint_{i}" for i in range(1, 7)] and not ros.velocity and not ros.effort


def test_can_frames_are_those_of_the_bus_log(recorded, decoded):
    lines = [(t, can_id, data) for t, _, can_id, data in read_candump(recorded.folder / "bus.log")]
    frames = [(t, ros.id, bytes(ros.data[: ros.dlc])) for t, ros in decoded["/can_frames"]]
    assert [(t // 1000, i, d) for t, i, d in sorted(frames)] == [(t // 1000, i, d) for t, i, d in sorted(lines)]
    assert not any(ros.is_extended or ros.is_rtr or ros.is_error for _, ros in decoded["/can_frames"])


def by_cycle(recorded, rows):
    """Messages by the cycle whose SYNC triggered the tactile frame that they come from: it was sampled earlier."""
    samples = [o.measurement.tactile for o in recorded.observations if o.measurement and o.measurement.tactile]
    cycles = {recorded.first_ns + sample.t_sample_ns: sample.cycle for sample in samples}
    return {cycles[time]: ros for time, ros in rows}


def vector(v):
    return (v.x, v.y, v.z)


def test_force_and_contact_are_those_the_task_logged(recorded, decoded):
    """The force to rounding, the place to 0.2 µm: both were computed again, in another process, from the measurement.

    The correction of the centroid's lag rests on the stiffness of the layer that the task found in its touch.
    """
    cycle, force, points = (recorded.log(name) for name in ("sample_cycle", "force_n", "contact_mm"))
    new = np.flatnonzero(np.isfinite(cycle) & (np.diff(cycle, prepend=-1) != 0))
    wrenches = by_cycle(recorded, decoded["/wrench"])
    felt = [vector(wrenches[cycle[row]].wrench.force) for row in new]
    np.testing.assert_allclose(np.linalg.norm(felt, axis=1), force[new], rtol=1e-12)
    assert force[new].max() == pytest.approx(2.0, abs=0.5)
    pressed = [r.wrench.force.z for _, r in decoded["/wrench"] if abs(r.wrench.force.z) > 0.5]
    assert len(pressed) > 50 and max(pressed) < 0, "z of the probe points at the object, which pushes back"
    touched = new[np.isfinite(points[new]).all(axis=1)]
    tf = [(t, ros) for t, ros in decoded["/tf"] if ros.transforms[0].child_frame_id == "contact"]
    contacts = by_cycle(recorded, tf)
    found = [vector(contacts[cycle[row]].transforms[0].transform.translation) for row in touched]
    assert len(found) > 100
    np.testing.assert_allclose(found, points[touched] * 1e-3, rtol=0, atol=2e-7)


def test_contacts_on_a_carrier_are_in_its_frame_which_moves_in_base(tmp_path):
    """Contact and probe come together by the frame that is sent beside them, and by the moments that the view shows."""
    changes = {"task.duration_s": 1.0, "outputs.figures": False, "shape.also": ()}
    result = canprobe.run("turntable", changes, bridge=["mcap"], out=tmp_path / "run")
    assert result.summary["bridges"]["mcap"]["error"] is None
    carriers, contacts = {}, {}
    with (tmp_path / "run" / "run.mcap").open("rb") as file:
        for _, channel, message, ros in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            if channel.topic == "/tf":
                (first, *_), t_s = ros.transforms, message.log_time * 1e-9
                if first.child_frame_id == "carrier":
                    carriers[t_s] = first
                elif first.child_frame_id == "contact":
                    contacts[t_s] = first
    assert {c.header.frame_id for c in carriers.values()} == {"base_link"}
    assert {c.header.frame_id for c in contacts.values()} == {"carrier"} and len(contacts) > 50
    turned = [2.0 * np.arctan2(c.transform.rotation.z, c.transform.rotation.w) for c in carriers.values()]
    assert np.polyfit([*carriers], turned, 1)[0] == pytest.approx(np.radians(5.0), rel=0.02)
    run, chain = read_run(tmp_path / "run"), result.plan.setup.arm.model.chain
    moments = [moment for moment in map(run.at, run.times(0.1)) if moment.contact is not None]
    assert len(moments) > 5
    for moment in moments:
        centre = forward(chain, moment.q) @ result.plan.setup.probe.T_flange_probe[:, 3]
        seen = np.linalg.inv(moment.T_base_carrier) @ centre
        assert np.linalg.norm(seen[:3] - moment.contact.point) == pytest.approx(0.04, abs=2e-3)


def test_the_surface_patch_lies_on_the_true_cylinder(recorded, decoded):
    scene = recorded.result.plan.scene
    _, cloud = decoded["/surface_patch"][-1]
    rows = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 4)
    assert [f.name for f in cloud.fields] == ["x", "y", "z", "sigma"] and cloud.point_step == 16
    assert cloud.header.frame_id == "base_link" and cloud.width == len(rows) > 100
    angle = np.radians(scene.object.rotation_deg[2])
    axis = np.array([np.cos(angle), np.sin(angle), 0.0])
    centre = np.array(scene.object.position_mm) * 1e-3 - (0, 0, RADIUS)
    away = rows[:, :3] - centre
    distance = np.linalg.norm(away - np.outer(away @ axis, axis), axis=1)
    assert np.abs(distance - RADIUS).max() < 1e-3  # the far side of the tangent plane would be 2 mm off
    near = np.linalg.norm(rows[:, :3] - rows[:, :3].mean(axis=0), axis=1) < 4e-3
    assert np.abs(distance[near] - RADIUS).max() < 3e-4


def test_the_image_of_the_taxels_shows_one_patch_within_the_window(decoded):
    image = max((ros for _, ros in decoded["/taxels/image"]), key=lambda ros: sum(ros.data))
    assert (image.encoding, len(image.data), image.step) == ("mono8", 256, 16)
    rows, columns = np.nonzero(np.frombuffer(bytes(image.data), np.uint8).reshape(16, 16))
    assert rows.max() - rows.min() < 8 and columns.max() - columns.min() < 8


@pytest.mark.slow(reason="writes the whole file once more")
def test_a_recorded_run_gives_the_same_messages_again(recorded, tmp_path):
    """From what the master measured, everything but the bridge's own state, message by message."""
    folder = tmp_path / "again"
    folder.mkdir()
    for name in ("bus.log", "scene.toml", "log.npz", "tactile.npz", "summary.json"):
        (folder / name).write_bytes((recorded.folder / name).read_bytes())
    replayed = replay_into(folder, ("mcap",))
    assert replayed.bridges["mcap"]["error"] is None and replayed.bridges["mcap"]["dropped"] == 0
    assert replayed.result is not None and replayed.result.summary["online"]["K_max_difference_per_m"] == 0
    live, again = (
        sorted(
            m
            for m in messages_of(path / "run.mcap")
            if m[0] not in ("/diagnostics", "/tf_static", "/robot_description")
        )
        for path in (recorded.folder, folder)
    )
    assert len(live) > 10_000
    assert again == live


@pytest.mark.slow(reason="a full disk once more; tests/cli/test_full_disk.py has most files")
def test_a_full_disk_leaves_no_part_of_the_file(recorded, tmp_path, capsys):
    folder = tmp_path / "full"
    folder.mkdir()
    for name in ("bus.log", "scene.toml", "log.npz"):
        (folder / name).write_bytes((recorded.folder / name).read_bytes())
    with room_for(100_000):
        assert main(["replay", str(folder), "--bridge", "mcap"]) == 3
    told = f"bridge mcap: {folder}/run.mcap: cannot be written: File too large"
    assert capsys.readouterr().err.splitlines()[-1] == f"canprobe: {told}"
    assert {path.name for path in folder.iterdir()} == {"bus.log", "scene.toml", "log.npz"}


def test_frames_of_can_fd_have_a_topic_of_their_own(recorded):
    """64 bytes do not fit can_msgs: they go where ros2_socketcan puts them, whole."""
    encoder = Encoder()
    data = bytes(range(64))
    sample = Sample(7, frames=((0x181, data, 5), (0x182, data[:8], 6)))
    messages = list(Messages(recorded.result.plan, encoder).of(sample))
    assert [topic.name for topic, _, _ in messages][:2] == ["/can_fd_frames", "/can_frames"]
    frame = encoder.store.deserialize_cdr(messages[0][2], "ros2_socketcan_msgs/msg/FdFrame")
    assert (frame.id, frame.len, bytes(frame.data)) == (0x181, 64, data)


def test_a_run_without_a_folder_cannot_have_a_file():
    with pytest.raises(UsageError, match="bridge mcap: it writes a file"):
        canprobe.run("free", duration_s=0.1, files=False, bridge=("mcap",))
