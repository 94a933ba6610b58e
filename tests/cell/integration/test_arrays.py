"""Arrays of other sizes and makes: planned, emulated, listened to and pressed, in lockstep."""

import re
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest
from undrawn import undrawn_run

import canprobe
from canprobe.cell.planning.report import plan_text
from canprobe.cell.scene.load import parse_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import PlanError, SafetyStop, SceneError, UsageError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.protocol.raw_image import ImageAssembler

LISTEN = """
[scene]
name = "listen"
[outputs]
figures = false
[sensor]
array = "{array}"
{sensor}
[object]
kind = "sphere"
radius_mm = 30
[task]
kind = "listen"
duration_s = {duration}
"""
TOUCH = """
[scene]
name = "touch"
[outputs]
figures = false
[sensor]
{sensor}
[object]
kind = "cylinder"
radius_mm = 36
position_mm = [-120, -122.5, 374]
rotation_deg = [0, 0, 20]
[task]
kind = "{kind}"
clearance_mm = 0.3
duration_s = 1
"""
FREE = """rows = 10
columns = 12
pitch_mm = 2
mode = "image"
channel = "can1"
[wire]
kind = "frames"
ids = ["510h-51Eh"]
frames = ["ss tt uu vv ww xx yy zz"]
latency_ms = 4
latency_sigma_ms = 0.5"""
RAW = ("uskin4x4", "linker12x6", "icub-triangles")
"""Arrays that run on their own time, that are polled, and whose counts fall."""


def listen(array, sensor="", duration=1.0):
    return parse_scene(LISTEN.format(array=array, sensor=sensor, duration=duration))


def touch(sensor, kind="scan"):
    return parse_scene(TOUCH.format(sensor=sensor, kind=kind))


@pytest.mark.parametrize("array", RAW)
def test_an_array_of_raw_frames_is_started_listened_to_and_recorded(array, tmp_path):
    scene = listen(array, duration=3.0 if array == "uskin4x4" else 1.0)
    plan, result = canprobe.plan(scene), canprobe.run(scene, out=tmp_path / "run")
    summary, raw = result.summary, plan.setup.array.raw
    assert summary["completed"] and summary["cycle"]["torn_frames"] == 0
    assert summary["bus_load"]["can0"]["measured"] < plan.traffic.load
    measured = canprobe.measure_traffic(tmp_path / "run", plan)
    assert measured.as_planned, measured.text()
    sent = [(t_ns, can_id, data) for t_ns, _, can_id, data in read_candump(tmp_path / "run" / "bus.log")]
    assert {can_id for _, can_id, _ in sent} <= {frames.can_id for frames in plan.raw} | {0x080, 0x77F, 0x000}
    commands = [(can_id, data) for _, can_id, data in sent]
    assert all(frame in commands for frame in (*raw.start, *raw.stop))
    # the record is whole: every image can be had from it again, at the rate of the file
    assembler = ImageAssembler(raw.image, 10**9)
    images = [image for t_ns, can_id, data in sent if (image := assembler.push(can_id, data, t_ns)) is not None]
    times = np.array([image.t_ns for image in images])
    assert np.median(np.diff(times)) * 1e-9 == pytest.approx(1 / plan.setup.array.rate_hz, rel=0.01)
    normal = np.array([image.counts[raw.normal :: raw.image.axes] for image in images], dtype=float)
    falls = raw.full_scale < raw.unloaded
    assert (normal.min() < raw.unloaded - 20) if falls else (normal.max() > raw.unloaded + 20)
    force = np.load(tmp_path / "run" / "log.npz")["force_n"]
    assert 0.5 < np.nanmax(force) < 6.0  # the plant presses with 2 N on the average, and 3.9 N at most


def test_an_array_that_samples_at_sync_is_placed_at_its_syncs(tmp_path):
    sensor = FREE.replace('channel = "can1"', "rate_hz = 100").replace("[wire]", '[wire]\nsampling = "sync"')
    tactile = canprobe.run(listen("inch16", sensor, duration=0.5), out=tmp_path / "run").tactile
    after_sync_s = (tactile["t_sample_s"] - tactile["t_sample_s"][0]) % 0.01  # of every fourth SYNC
    assert len(tactile["t_s"]) == pytest.approx(50, abs=2)
    assert np.minimum(after_sync_s, 0.01 - after_sync_s).max() < 0.5e-3  # the first frame's way over the bus
    assert tactile["raw"].shape[1:] == (10, 12, 1) and (tactile["t_sigma_s"] == 0.5e-3).all()


@pytest.mark.parametrize(("sigma_ms", "applied"), [(0.1, True), (1.0, False)])
def test_the_latency_of_a_calibration_counts_where_it_is_sure(sigma_ms, applied, tmp_path):
    text = (resources.files("canprobe") / "calibrations/inch16.toml").read_text()
    text = re.sub("(?m)^latency_ms.*", "latency_ms = 2.0", text)
    file = tmp_path / "mine.toml"
    file.write_text(re.sub("(?m)^latency_sigma_ms.*", f"latency_sigma_ms = {sigma_ms}", text))
    sensor = FREE.replace('channel = "can1"', "rate_hz = 100").replace("[wire]", '{}\n[wire]\nsampling = "sync"')
    stated, found = (
        canprobe.run(listen("inch16", sensor.format(key), duration=0.2), out=tmp_path / name).tactile
        for name, key in (("stated", ""), ("found", f'calibration = "{file}"'))
    )
    earlier_s = stated["t_sample_s"] - found["t_sample_s"]
    assert earlier_s == pytest.approx(2e-3 if applied else 0.0, abs=1e-6)
    assert found["t_sigma_s"] == pytest.approx(np.hypot(0.5e-3, 1e-3 * sigma_ms) if applied else 0.5e-3)


def test_the_plan_sees_the_identifiers_of_raw_frames():
    with pytest.raises(PlanError, match=r'201h is RPDO1 of node 1 on can0; .*sensor.channel = "can1"'):
        canprobe.plan(touch('array = "uskin4x4"', "press"))
    own = touch('array = "uskin4x4"\nchannel = "can1"', "press")
    assert {frames.channel for frames in canprobe.plan(own).raw} == {"can1"}
    moved = {name: replace(joint, node_id=16 + i) for i, (name, joint) in enumerate(own.joints.items())}
    with pytest.raises(PlanError, match=r"710h is the heartbeat of node 16 on another bus, .*take other node ids"):
        canprobe.plan(replace(own, joints=moved))


BALL = {"sensor.channel": "can1", "object.kind": "sphere"}
SLOW = {"sensor.array": "linker12x6", "cycle.rate_hz": 125, "sensor.rate_hz": 125 / 3}


@pytest.mark.parametrize(
    "keys", [{"sensor.array": "uskin4x4", "object.radius_mm": 60}, SLOW | {"object.radius_mm": 15}], ids=["60", "15"]
)
def test_a_flat_array_reaches_its_force_on_any_ball_that_fits_on_it(keys, tmp_path):
    """It was taken for a sphere of 10 m: no depth that it goes to is too deep for that, and it pressed 0.4 to 1.5 N."""
    result = undrawn_run(canprobe.load_scene("press", BALL | keys | {"task.duration_s": 1.0}), out=tmp_path)
    assert result.summary["completed"] and result.summary["contact"]["force_rms_error_n"] < 0.3
    # a start frame has the identifier of an RPDO on the other bus: each goes where it belongs
    raw, frames = result.plan.setup.array.raw, list(read_candump(tmp_path / "bus.log"))
    assert {channel for _, channel, can_id, data in frames if (can_id, data) in raw.start} <= {"can1"}
    assert {channel for _, channel, can_id, data in frames if can_id == 0x201 and len(data) == 6} == {"can0"}


def test_a_ball_that_is_too_blunt_for_a_flat_array_is_told():
    keys = BALL | SLOW | {"object.radius_mm": 60}
    assert "at 2 N fits on what is rounder than a ball of 20 mm" in plan_text(canprobe.plan("press", keys))
    with pytest.raises(SafetyStop, match="runs off the edge of the array"):
        canprobe.run("press", keys, files=False)


@pytest.mark.parametrize("kind", ["scan", "calibrate"])
def test_a_flat_array_is_no_probe(kind):
    sensor = 'array = "uskin4x4"\nchannel = "can1"'
    scene = TOUCH.format(sensor=sensor, kind=kind)
    if kind == "calibrate":
        scene = scene.replace('kind = "cylinder"\nradius_mm = 36', 'kind = "sphere"\nradius_mm = 25')
    with pytest.raises(PlanError) as caught:
        canprobe.plan(parse_scene(scene))
    assert len(caught.value.problems) == 1 and "uskin4x4 is flat" in caught.value.problems[0]


def test_an_array_of_another_size_scans():
    few = canprobe.plan(touch("rows = 8\ncolumns = 8\npitch_mm = 3"))
    assert not few.setup.shape.patch
    assert "no curvature: fewer than 16 taxels" in dict(few.left_out)["curvature from the patch"]
    scene = touch(FREE)
    assert canprobe.plan(scene).setup.shape.patch
    result = canprobe.run(scene, {"shape.also": [], "cycle.rate_hz": 200.0}, files=False, duration_s=1.6)
    summary = result.summary  # a coarse array needs more path than 20 mm
    assert summary["completed"] and summary["contact"]["force_rms_error_n"] < 0.3
    assert summary["shape"]["kappa_est_per_m"][0] == pytest.approx(1 / 0.036, abs=3.0)


def test_a_node_of_another_size_computes_features():
    scene = touch('rows = 10\ncolumns = 12\npitch_mm = 2\nmode = "features"', "press")
    summary = canprobe.run(scene, bus="direct", files=False).summary
    assert summary["completed"] and summary["contact"]["force_rms_error_n"] < 0.3


def test_a_node_that_has_fewer_taxels_than_the_file_is_refused(tmp_path):
    """The packaged EDS with 8 image objects: that of an 8×8 array."""
    text = (resources.files("canprobe.fieldbus.eds") / "tactile_array.eds").read_text()
    head, rest = text.split("[2100sub0]")
    eds = tmp_path / "small.eds"
    eds.write_text(f"{head}[2100sub0]{rest.replace('DefaultValue=32', 'DefaultValue=8', 1)}")
    with pytest.raises(PlanError, match=r"8 objects of 8 taxels \(2100h\), and the 16 × 16 taxels .* need 32"):
        canprobe.plan(touch(f'eds = "{eds}"'))
    canprobe.plan(touch(f'eds = "{eds}"\nrows = 8\ncolumns = 8\npitch_mm = 3'))


def test_the_speed_of_a_scan_is_limited_by_the_image_rate():
    slow = "rows = 8\ncolumns = 8\npitch_mm = 3\nrate_hz = 5"
    with pytest.raises(PlanError, match=r"5 mm from one image to the next .* lower task.speed_mm_s to 15"):
        canprobe.plan(touch(slow))


def test_only_a_free_running_array_has_any_rate():
    assert canprobe.plan(listen("uskin4x4", "rate_hz = 90")).raw[0].rate_hz == 90
    with pytest.raises(PlanError, match=r"an image every 5\.714 cycles cannot be asked for; take 66\.6667 or 80 Hz"):
        canprobe.plan(listen("linker12x6", "rate_hz = 70"))


def test_an_array_may_come_on_its_own_sphere(tmp_path):
    file = tmp_path / "ball.toml"
    file.write_text("[array]\n[sensor]\nrows = 8\ncolumns = 8\npitch_mm = 2\n[probe]\nradius_mm = 20\n")
    setup = resolve(touch(f'array = "{file}"'))
    assert (setup.array.pad.mount_radius_m, setup.probe.radius) == (0.02, 0.02)


def test_a_list_of_places_with_counts_that_are_signed_fall_and_are_tared_scans():
    places = [
        [round((column - 7.5) * 1.55 + (0.4 if row % 2 else -0.4), 3), round((row - 7.5) * 1.6, 3), 0]
        for row in range(16)
        for column in range(16)
    ]
    wire = """kind = "frames"
ids = ["300h-33Fh"]
frames = ["aaaa bbbb cccc dddd"]
byte_order = "little"
signed = true
unloaded_counts = -120
full_scale_counts = -30000
tare_images = 20"""
    sensor = (
        f'pitch_mm = 1.575\npositions_mm = {places}\nmode = "image"\nrate_hz = 80\nchannel = "can1"\n[wire]\n{wire}'
    )
    result = canprobe.run(touch(sensor), {"shape.also": []}, duration_s=1.2, files=False)
    summary = result.summary
    assert summary["completed"] and summary["contact"]["contact_fraction"] == 1.0
    assert abs(summary["contact"]["force_true_bias_n"]) < 0.06, "3 % of 2 N: the model is that of separate taxels"
    assert summary["shape"]["kappa_est_per_m"][0] == pytest.approx(1 / 0.036, rel=0.1), "by the motion alone"


def test_a_list_has_no_features_and_a_scan_that_would_leave_it_is_refused():
    small = [[x, y, 0] for y in range(-2, 3) for x in range(-2, 3)]
    sensor = f'rows = 5\ncolumns = 5\npitch_mm = 1\npositions_mm = {small}\nrate_hz = 100\nchannel = "can1"\nmode = '
    with pytest.raises(PlanError, match=r"would run off the array: .* of the array, which reaches 2\.5 mm"):
        canprobe.plan(touch(sensor + '"image"'))
    with pytest.raises(PlanError, match=r'sensor\.mode = "features": .* set sensor\.mode = "image"'):
        canprobe.plan(touch(sensor + '"features"', "press"))


@pytest.mark.parametrize(
    ("sensor", "problem"),
    [
        ("pitch_mm = [1, 2, 3]", "sensor.pitch_mm: expected"),
        ("rows = 1\ncolumns = 1\npitch_mm = [1, 2]\npositions_mm = [[0, 0, 0]]", "expected one distance with"),
        ('array = "uskin4x4"\n[wire]\nunloaded_counts = -5', "set wire.signed = true for two's complement"),
        ('array = "uskin4x4"\n[wire]\nsigned = true\nfull_scale_counts = 40000', "-32768 to 32767 in 16 signed bits"),
        ('array = "inch61"', "did you mean inch16?"),
        ("rows = 20", 'sensor.rows: expected at most 16 with wire.kind = "canopen"'),
        ("rows = 6\ncolumns = 6", "sensor.window: expected at most the 6 taxels"),
        ('array = "uskin4x4"\nmode = "window"', 'sensor.mode: expected "image"'),
        ('array = "uskin4x4"\nrows = 5', "wire.frames: 16 identifiers"),
        ("positions_mm = [[0, 0, 0]]", "sensor.positions_mm: expected 256 points"),
        ("[wire]\npoll = ['027#00']", 'wire.poll: only with kind = "frames"'),
        ("array = 'linker12x6'\n[wire]\nsampling = 'free'", 'wire.poll: only with wire.sampling = "polled"'),
        ("array = 'linker12x6'\n[wire]\nids = ['27']", 'such as "710h" or "710h-71Fh"'),
        ("array = 'linker12x6'\n[wire]\nframes = ['xyz']", "two characters"),
    ],
)
def test_contradictions_are_said_with_their_key(sensor, problem):
    with pytest.raises(SceneError) as caught:
        touch(sensor, "press")
    assert any(problem in one for one in caught.value.problems), caught.value.problems


def test_an_array_that_is_silent_is_named():
    scene = listen("icub-triangles", "emulated = true")
    session = Session(scene)
    session.buses.world.raw_array.running = False
    session.buses.world.raw_array.receive = lambda *_: []  # deaf
    with pytest.raises(canprobe.BusError, match=r"sent 0 of 1 images of its frames 4D0h-4D1h"), session:
        pass


def test_an_array_that_falls_silent_ends_the_run():
    with Session(listen("linker12x6", duration=3.0)) as session:
        array = session.buses.world.raw_array
        cycles = []

        def mute(measurement):
            cycles.append(measurement.cycle)
            if measurement.cycle == 200:
                array.running = False

        with pytest.raises(canprobe.SafetyStop, match="no tactile frame for 49 cycles"):
            session.run(make_task(session.plan), mute)
    assert cycles[-1] == pytest.approx(200 + 48, abs=8)  # six images of eight cycles, from the last one


def test_a_saved_scene_takes_its_array_file_along(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('[array]\ntitle = "mine"\n[sensor]\nrows = 8\ncolumns = 8\npitch_mm = 3\nrate_hz = 100\n')
    text = LISTEN.format(array="mine.toml", sensor="rate_hz = 50", duration=0.2)
    (tmp_path / "scene.toml").write_text(text)
    scene = canprobe.load_scene(tmp_path / "scene.toml")
    assert (scene.sensor.rows, scene.sensor.rate_hz) == (8, 50)  # the file's, and the scene's over it
    canprobe.run(scene, out=tmp_path / "run")
    file.unlink()
    again = canprobe.load_scene(tmp_path / "run" / "scene.toml")
    assert (again.sensor.rows, again.sensor.rate_hz) == (8, 50)


def test_a_lockstep_bus_has_no_real_array():
    scene = listen("uskin4x4", "emulated = false")
    with pytest.raises(UsageError, match=r"sensor\.emulated = false"):
        canprobe.run(scene)
