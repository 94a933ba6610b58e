"""The tactile node: whole frames, one sampling instant, latency, window, tare, gain, overload; points 61–65."""

import numpy as np
import pytest
from node_fuzz import Watched, rage

from canprobe.cell.emulated.array import TactileApplication
from canprobe.cell.emulated.array_faults import CELL_FAULTS
from canprobe.cell.master.tactile_frame import decode
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.node.stored_file import keep_in_file
from canprobe.fieldbus.protocol.frames import NmtState
from canprobe.fieldbus.protocol.tactile import WINDOW_SIZES, FrameAssembler, TactileMode, window_words
from canprobe.fieldbus.tools.faults import FaultyNode, parse_fault

MS = 1_000_000
CYCLE = 2_500_000
OFF = 0x80000000
TARE = 0x65726174


class Sensor:
    """The node, a SYNC source and an assembler."""

    def __init__(self, bench_class, plant, *, mode=TactileMode.WINDOW, start=0, latency=1, tare_images=4, fault=None):
        node = SlaveNode(load_eds("tactile_array", 16), 16, TactileApplication(plant, latency, tare_images))
        self.node = node
        faults = [] if fault is None else [parse_fault(f"node 16: {fault}", CELL_FAULTS)]
        self.bench = bench_class(FaultyNode(node, faults))
        self.plant = plant
        self.k = 0
        node.start(0)
        for order in [(0x1019, 0, 240, 1), (0x2000, 0, int(mode), 1), (0x2001, 0, 0, 1)]:
            assert self.bench.write(*order) == 0
        self.configure(mode, start)
        self.assembler = FrameAssembler(self.cob_ids, mode, 2 * CYCLE)

    def configure(self, mode, start):
        content = {
            TactileMode.WINDOW: [0x21100040 | sub << 8 for sub in range(1, 9)],
            TactileMode.IMAGE: [0x21000040 | sub << 8 for sub in range(1, 33)],
            TactileMode.FEATURES: [0x21300240],
        }[mode]
        words = [0x21300140 if mode is TactileMode.FEATURES else 0x21200040, *content]
        self.cob_ids = list(range(0x511, 0x511 + len(words)))
        for number in range(33):
            assert self.bench.write(0x1800 + number, 1, OFF | 0x511 + number, 4) == 0
        for number, word in enumerate(words):
            self.bench.configure(0x1800 + number, cob_id=0x511 + number, words=[word], type=2, start=start)

    def go(self, t_ns=0):
        self.bench.nmt(0x01, t_ns)
        assert self.node.state is NmtState.OPERATIONAL
        return self

    def sync(self):
        """One SYNC; the frame that came with it, if any."""
        self.k += 1
        frames = self.bench.send(0x80, f"{(self.k - 1) % 240 + 1:02x}", self.k * CYCLE)
        messages = [self.assembler.push(can_id, bytes.fromhex(data), self.k * CYCLE) for can_id, data in frames]
        done = [message and decode(message, (16, 16)) for message in messages]
        whole = [frame for frame in done if frame is not None]
        assert len(whole) == bool(frames)  # all or nothing
        return whole[0] if whole else None

    def frames(self, count):
        found = []
        while len(found) < count:
            frame = self.sync()
            if frame is not None:
                found.append(frame)
        return found


@pytest.fixture
def make(bench, plant):
    return lambda **options: Sensor(type(bench), plant, **options)


def spot(row, column, value=100):
    image = np.zeros((16, 16), np.uint8)
    image[row, column] = value
    return image


def test_sensor_the_frame_shows_the_trigger_before_and_its_age(make, plant):
    plant.image = spot(4, 4, 10)
    sensor = make(mode=TactileMode.IMAGE).go(t_ns=1 * MS)
    plant.image = spot(4, 4, 20)
    frames = []
    for value in (30, 40):
        frames += sensor.frames(1)
        plant.image = spot(4, 4, value)
    frames += sensor.frames(1)
    assert [int(frame.taxels[4, 4]) for frame in frames] == [10, 20, 30]
    assert [frame.header.sample_age_us for frame in frames] == [4000, 5000, 5000]
    assert [frame.header.sync_counter for frame in frames] == [2, 4, 6]


@pytest.mark.parametrize(("latency", "ages"), [(0, [0, 0, 0, 0]), (1, [5000] * 4), (2, [5000, 10000, 10000, 10000])])
def test_sensor_latency_in_frames(make, latency, ages):
    sensor = make(latency=latency).go()
    assert [frame.header.sample_age_us for frame in sensor.frames(4)] == ages


def test_sensor_age_saturates(make):
    sensor = make().go()
    sensor.k = 39
    assert sensor.frames(1)[0].header.sample_age_us == 0xFFFF


def test_sensor_a_trigger_that_is_stamped_before_its_sample_has_age_0(make):
    """As by a receiver whose clock was set back; the header has no negative age."""
    sensor = make().go(t_ns=100 * MS)
    assert [frame.header.sample_age_us for frame in sensor.frames(2)] == [0, 5000]


@pytest.mark.parametrize(("start", "counters"), [(1, [1, 3, 5]), (2, [2, 4, 6]), (0, [2, 4, 6])])
def test_sensor_start_value_sets_the_phase(make, start, counters):
    sensor = make(start=start).go()
    assert [frame.header.sync_counter for frame in sensor.frames(3)] == counters


def test_sensor_62_counter_counts_frames_mod_256(make):
    sensor = make(mode=TactileMode.FEATURES).go()
    counters = [frame.header.frame_counter for frame in sensor.frames(260)]
    assert counters == [n % 256 for n in range(260)]
    assert sensor.assembler.lost == 0


def test_sensor_63_window_stays_without_contact_and_does_not_flicker(make, plant):
    plant.image = spot(12, 12)
    sensor = make().go()
    assert sensor.frames(1)[0].window[:2] == (8, 8)
    plant.image = np.zeros((16, 16), np.uint8)
    assert {frame.window[:2] for frame in sensor.frames(4)} == {(8, 8)}
    origins = set()
    for turn in range(12):  # centroid between 7.9 and 8.1: half way between two origins
        plant.image = spot(8, 8)
        plant.image[8, 7 if turn % 2 else 9] = 10
        origins.add(sensor.frames(1)[0].window[:2])
    assert len(origins) <= 2  # the way there, and then one place


def test_sensor_64_threshold_and_gain(make, plant):
    plant.image = spot(5, 5, 40) + spot(6, 6, 39) + spot(7, 7, 200)
    sensor = make(mode=TactileMode.IMAGE)
    for order in [(0x2001, 0, 60, 1), (0x2002, 0, 1500, 2)]:
        assert sensor.bench.write(*order) == 0
    frame = sensor.go().frames(1)[0]
    assert [int(frame.taxels[i, i]) for i in (5, 6, 7)] == [60, 0, 255]
    assert frame.header.overload


def test_sensor_64_what_tare_and_gain_leave_is_rounded_to_whole_counts(make, plant):
    plant.image = spot(5, 5, 101) + spot(6, 6, 103) + spot(7, 7, 2)
    sensor = make(mode=TactileMode.IMAGE).go()
    assert sensor.bench.write(0x2002, 0, 1250, 2) == 0
    taxels = sensor.frames(1)[0].taxels
    assert [int(taxels[i, i]) for i in (5, 6, 7)] == [126, 129, 2]  # 126.25, 128.75, 2.5: to the even one


def test_sensor_64_tare_takes_the_mean_of_the_next_images(make, plant):
    sensor = make(mode=TactileMode.IMAGE, tare_images=2).go()
    assert sensor.bench.write(0x2003, 0, 1, 4) == 0x08000020
    assert sensor.bench.write(0x2003, 0, TARE, 4) == 0
    for value in (30, 34):
        plant.image = spot(3, 3, value) + spot(4, 4, 5)
        sensor.frames(1)
    plant.image = spot(3, 3, 50)
    sensor.frames(1)
    frame = sensor.frames(1)[0]
    assert (frame.taxels[3, 3], frame.taxels[4, 4], frame.taxels.sum()) == (18, 0, 18)


def test_sensor_features_by_hand(make, plant):
    plant.image = spot(4, 6, 100) + spot(6, 10, 100)
    features = make(mode=TactileMode.FEATURES).go().frames(1)[0].features
    assert (features.row, features.col, features.peak) == (5.0, 8.0, 100)
    assert (features.var_rr, features.var_rc, features.var_cc) == (1.0, 2.0, 4.0)
    force_n = 200 / 255 * 100_000 * (1.5875e-3) ** 2
    assert features.force_n == pytest.approx(force_n, abs=1 / 800)


def test_sensor_a_finer_adc_sharpens_the_force_and_leaves_taxels_whole(make, plant):
    plant.image = np.zeros((16, 16))
    plant.image[4:10, 4:10] = 50.4
    taxels = make(mode=TactileMode.IMAGE).go().frames(1)[0].taxels
    assert (taxels.max(), taxels.sum()) == (50, 36 * 50)
    features = make(mode=TactileMode.FEATURES).go().frames(1)[0].features
    assert features.force_n == pytest.approx(36 * 50.4 / 255 * 100_000 * 1.5875e-3**2, abs=1 / 800)
    assert (features.row, features.col, features.peak) == (6.5, 6.5, 50)


def test_sensor_features_without_contact(make):
    features = make(mode=TactileMode.FEATURES).go().frames(1)[0].features
    assert (features.force_n, features.row, features.col, features.peak) == (0.0, 7.5, 7.5, 0)


def test_sensor_is_silent_out_of_operational_and_starts_afresh(make, plant):
    sensor = make(mode=TactileMode.IMAGE).go()
    plant.image = spot(1, 1)
    sensor.frames(2)
    sensor.bench.nmt(0x80)
    assert [sensor.sync() for _ in range(4)] == [None] * 4
    plant.image = spot(2, 2)
    sensor.go(t_ns=sensor.k * CYCLE + 1)
    frame = sensor.frames(1)[0]
    assert (frame.taxels[2, 2], frame.taxels[1, 1]) == (100, 0)


# Object 2008h of the tactile node: which windows it takes, when, and what it then sends.

SIZE = 0x2008


@pytest.fixture
def sensor(bench, plant):
    node = SlaveNode(load_eds("tactile_array", 16), 16, TactileApplication(plant, 0))
    node.start(0)
    found = type(bench)(node)
    for order in ((0x1019, 0, 240, 1), (0x2001, 0, 0, 1)):
        assert found.write(*order) == 0
    return found


@pytest.mark.parametrize("value, abort", [(3, 0x06090032), (13, 0x06090031), (5, 0x06090030), (11, 0x06090030)])
def test_sizes_that_it_does_not_have(sensor, value, abort):
    assert sensor.write(SIZE, 0, value, 1) == abort
    assert sensor.node.dictionary.number(SIZE) == 8


@pytest.mark.parametrize("value", WINDOW_SIZES)
def test_sizes_that_it_has_until_it_is_operational(sensor, value):
    assert sensor.write(SIZE, 0, value, 1) == 0
    sensor.nmt(0x01)
    assert sensor.write(SIZE, 0, value, 1) == 0, "the same value changes nothing"
    assert sensor.write(SIZE, 0, 4 if value != 4 else 6, 1) == 0x08000022
    sensor.nmt(0x80)
    assert sensor.write(SIZE, 0, 4 if value != 4 else 6, 1) == 0


@pytest.mark.parametrize("side", WINDOW_SIZES)
@pytest.mark.parametrize("spot", [(0, 15), (8, 3), (15, 0)])
def test_the_window_holds_the_contact_wherever_it_is(sensor, plant, side, spot):
    plant.image = np.zeros((16, 16), np.uint8)
    plant.image[spot] = 99
    assert sensor.write(SIZE, 0, side, 1) == 0
    for number in range(33):
        assert sensor.write(0x1800 + number, 1, OFF | 0x511 + number, 4) == 0
    for number, word in enumerate([0x21200040, *(0x21100040 | sub << 8 for sub in range(1, window_words(side) + 1))]):
        sensor.configure(0x1800 + number, cob_id=0x511 + number, words=[word], type=1)
    sensor.nmt(0x01)
    assembler = FrameAssembler(range(0x511, 0x512 + window_words(side)), TactileMode.WINDOW, CYCLE, window=side)
    frames = sensor.send(0x80, "01", CYCLE)
    found = [assembler.push(can_id, bytes.fromhex(data), CYCLE) for can_id, data in frames]
    assert found[-1] is not None and found[-1].header.window == side
    assert np.array_equal(decode(found[-1], (16, 16)).taxels, plant.image)
    row, column = found[-1].header.origin_row, found[-1].header.origin_col
    assert sensor.read(0x2006) == row << 4 | column
    ideal = [min(max(at - (side - 1) / 2, 0), 16 - side) for at in spot]
    assert abs(row - ideal[0]) <= 0.75 and abs(column - ideal[1]) <= 0.75


def test_random_and_mutated_frames(plant):
    rage(Watched(SlaveNode(load_eds("tactile_array", 5), 5, TactileApplication(plant))), 30_000, seed=20260)


SAVE = 0x65766173


def test_the_tare_of_the_sensor_comes_back_and_only_with_its_group(connect_sensor, plant):
    plant.image[3, 3] = 30
    first = connect_sensor()
    first.write(0x2003, 0, 0x65726174, 4)
    first.nmt(0x01)
    assert first.write(0x1010, 2, SAVE, 4) == 0  # communication parameters only
    assert connect_sensor().node.store.kept == b""
    assert first.write(0x1010, 3, SAVE, 4) == 0
    assert connect_sensor().node.application._tare[3, 3] == 30
    assert first.write(0x1011, 1, 0x64616F6C, 4) == 0
    assert connect_sensor().node.application._tare is None


@pytest.fixture
def connect_sensor(bench, plant, tmp_path):
    def make():
        node = SlaveNode(load_eds("tactile_array", 16), 16, TactileApplication(plant, tare_images=1))
        keep_in_file(node, tmp_path / "node016.json")
        node.start(0)
        return type(bench)(node)

    return make


def images_with(make, plant, fault, shown):
    """Images that the master gets of an array with a fault from 10 ms on, while the plant shows one after another."""
    sensor = make(mode=TactileMode.IMAGE, latency=0, fault=f"{fault} at 10 ms").go()
    images = []
    for image in shown:
        plant.image = image
        images += [frame.taxels.astype(int) for frame in sensor.frames(1)]
    return images


def changing(count):
    """Images of which each taxel changes from one to the next, with a row that is not pressed."""
    rows = np.arange(256, dtype=np.uint8).reshape(16, 16) // 2 + 40
    rows[15] = 0
    return [rows + np.uint8(image) * (rows > 0) for image in range(count)]


def test_fault_a_replayed_stretch_repeats_itself_and_a_single_image_has_fresh_noise(make, plant):
    shown = changing(9)
    images = images_with(make, plant, "replayed-image images=3 noise=0", shown)
    assert [int(image[0, 0]) for image in images] == [40, 41, 42, 43, 41, 42, 43, 41, 42]
    images = images_with(make, plant, "replayed-image images=1 noise=2 seed=7", changing(40))
    left = np.array(images[2:]) - images[1]
    assert not left[:, 15].any()
    assert left[:, :15].std(axis=(1, 2)) == pytest.approx(np.full(38, 2.0), rel=0.2)
    assert abs(left[:, :15].mean()) < 0.1


def test_fault_a_lost_gain_scales_every_taxel(make, plant):
    shown = changing(4)
    images = images_with(make, plant, "gain-lost gain=0.3", shown)
    assert np.array_equal(images[0], shown[0])
    assert np.array_equal(images[2], np.rint(0.3 * shown[2]))


def test_fault_stuck_rows_keep_their_values_while_the_others_go_on(make, plant):
    shown = changing(5)
    images = images_with(make, plant, "stuck-rows first=4 rows=2", shown)
    stuck = np.isin(np.arange(16), (4, 5))
    assert np.array_equal(images[4][stuck], shown[1][stuck])
    assert np.array_equal(images[4][~stuck], shown[4][~stuck])
