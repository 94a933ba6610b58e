"""Torque limit 6072h and feed-forwards 60B1h, 60B2h: how they reach the plant."""

CSP, CSV, CST = 8, 9, 10
HOLD = "0f0000000000"


def test_position_mode_feeds_both_forward_and_takes_them_back(rig, plant):
    rig.at_work(CSP, 0x607A0020).put(_6072=800, _60B1=1500, _60B2=120).cycles(3, HOLD)
    assert plant.loops[-1] == (0, 800, 1500.0, 120.0)
    told = len(plant.loops)
    rig.cycles(5, HOLD)
    assert len(plant.loops) == told  # changes only
    rig.word(0x07)
    assert plant.loops[-1] == (0, 800, 0.0, 0.0)


def test_position_mode_feeds_what_an_rpdo_brings(rig, plant):
    rig.at_work(CSP, 0x607A0020, 0x60B20010)
    for torque in (120, 120, -40):
        rig.cycles(2, HOLD + torque.to_bytes(2, "little", signed=True).hex())
    rig.cycles(1)
    assert plant.loops == [(0, 2000, 0.0, 120.0), (0, 2000, 0.0, -40.0)]
    rig.word(0x07)
    assert plant.loops[2:] == [(0, 2000, 0.0, 0.0)]
    rig.word(0x0F)
    rig.cycles(3, HOLD + "d8ff")
    assert plant.loops[3:] == [(0, 2000, 0.0, -40.0)]


def test_velocity_mode_feeds_torque_only(rig, plant):
    rig.at_work(CSV, 0x60FF0020).put(_60B1=1500, _60B2=120).cycles(3, HOLD)
    assert plant.loops == [(0, 2000, 0.0, 120.0)]
    rig.word(0x07)
    assert plant.loops[-1][2:] == (0.0, 0.0)


def test_torque_mode_feeds_nothing(rig, plant):
    rig.at_work(CST, 0x60710010).put(_60B1=1500, _60B2=120).cycles(3, "0f000000")
    assert plant.loops == []


def test_the_limit_counts_in_every_mode(rig, plant):
    rig.enable(1).put(_6072=500)
    assert plant.loops[-1] == (0, 500, 0.0, 0.0)
