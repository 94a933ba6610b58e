"""What callers put in the place of a scene's values: as strict as the file, and open to numpy's numbers."""

import json

import numpy as np
import pytest

import canprobe
from canprobe.errors import UsageError
from canprobe.scene.load import load_scene
from canprobe.session.session import resolve_scene
from canprobe.session.target import Target

PRESS = load_scene("press")


def put(scene, *, interface=None, channel=None, bitrate=None, **values):
    return resolve_scene(scene, Target.over(scene, interface, channel, bitrate), **values)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"seed": 1.5}, "seed: expected an integer from 0"),
        ({"seed": -1}, "seed: "),
        ({"seed": "1"}, "seed: .* got '1'"),
        ({"seed": True}, "seed: "),
        ({"duration_s": float("nan")}, "duration_s: expected a finite number, got nan|duration_s: .* above 0"),
        ({"duration_s": -1}, "duration_s: expected a number above 0"),
        ({"duration_s": 1e9}, "duration_s: expected a number above 0 up to 86400"),
        ({"channel": "a b"}, "channel: expected text without spaces, in ASCII, got 'a b'"),
        ({"channel": "ü"}, "channel: "),
        ({"channel": {"can0": ""}}, "channel: "),
        ({"channel": {"can1": "vcan1"}}, "channel: the scene has no channel can1, only can0"),
        ({"bitrate": 0}, "bitrate: expected an integer from 10000"),
        ({"interface": 3}, "interface: expected text"),
    ],
)
def test_a_value_that_no_file_could_have(values, told):
    with pytest.raises(UsageError, match=told):
        put(PRESS, **values)


def test_numbers_of_numpy_become_those_of_python():
    scene = put(PRESS, seed=np.int64(3), duration_s=np.float32(0.5), bitrate=np.int32(500_000))
    values = [scene.seed, scene.task.duration_s, scene.bus.bitrate]
    assert [type(value) for value in values] == [int, float, int]
    assert json.loads(json.dumps(values)) == [3, 0.5, 500_000]


def test_what_is_not_given_stays():
    assert resolve_scene(PRESS) == put(PRESS) == PRESS


@pytest.mark.parametrize("call", [canprobe.plan, canprobe.run, lambda scene: canprobe.open_cell(scene).__enter__()])
@pytest.mark.parametrize("scene", ["press", None])
def test_a_name_in_the_place_of_a_scene(call, scene):
    with pytest.raises(UsageError, match=r"scene: expected what canprobe\.load_scene returns, got"):
        call(scene)
