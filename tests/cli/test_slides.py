"""What users read of an arm whose joints slide: millimetres, and no degree."""

import json
import re

import numpy as np
import pytest

import canprobe
from canprobe.cell.scene.load import load_scene, parse_scene
from canprobe.cli import main
from canprobe.errors import PlanError

FREE = 'cell = "gantry"\n[scene]\nname = "s"\n[task]\nkind = "free"\n'


def test_the_joint_check_moves_and_tells_in_mm(capsys):
    assert main(["up", "gantry", "--check-joints", "--yes", "--set", "cycle.rate_hz=200"]) == 0
    said = capsys.readouterr().err
    assert re.findall(r"joint \d at .*", said) == [
        f"joint {i} at {at}.00 mm: asked +3.49 mm, moved +3.49 mm: as expected"
        for i, at in ((1, 200), (2, 200), (3, 150))
    ]
    assert "the arm stands at 200.00, 200.00, 150.00 mm, its flange at" in said


def test_the_plan_has_speeds_in_mm_per_second(capsys):
    assert main(["plan", "gantry", "--full"]) == 0
    speeds = capsys.readouterr().out.partition("joint speeds:")[2].partition("uses:")[0]
    assert speeds.count("mm/s") == 3 and "deg" not in speeds
    assert main(["plan", "gantry", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["joint_speeds"]["units"] == ["mm/s"] * 3


def test_the_log_has_metres(tmp_path):
    result = canprobe.run(load_scene("gantry"), out=tmp_path, duration_s=0.1)
    assert not [name for name in result.log if name.endswith("rad")]
    assert result.log["q_m"][0] == pytest.approx((0.2, 0.2, 0.15), abs=1e-5)
    table = canprobe.load_table(tmp_path / "log.npz")
    assert table.attrs["units"]["q_m_2"] == table.attrs["units"]["q_target_m_0"] == "m"
    assert np.isfinite(table["q_target_m_1"]).any()


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ("[joints.x]\nstart_mm = 2\nswing_mm = 0\n", r"joints\.x\.start_mm: at 2 mm, allowed 3\.5 to 396\.5 mm"),
        (
            "[limits]\njoint_margin_mm = 300\n[joints.x]\nstart_mm = 350\n",
            r"joints\.x\.start_mm: at 350 mm, allowed 300 to 100 mm \(300 mm from its stops\)",
        ),
        (
            "[joints.z]\nswing_mm = 145\nspeed_mm_s = 1\n",
            r"joint 3 would need 227.8 mm/s, allowed 1; .*swing_mm of the joints",
        ),
    ],
)
def test_refusals_name_keys_in_mm(keys, said):
    with pytest.raises(PlanError, match=said):
        canprobe.plan(parse_scene(FREE + keys))
