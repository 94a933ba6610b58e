"""The master against an emulated node that has the objects of the device's EDS."""

from pathlib import Path

import pytest
from io_master import DeviceLostError, IoMaster

EDS = Path(__file__).parent / "device" / "CANopenDemo" / "demo" / "demoDevice.eds"


@pytest.fixture
def device(emulated_nodes):
    (device,) = emulated_nodes(EDS)
    return device


@pytest.fixture
def master(device, canopen_network, judge):
    master = IoMaster(canopen_network, 1, str(EDS), sleep=canopen_network.pass_time)
    master.start()
    return master


def test_outputs_are_set_and_switched_off_at_the_end(master, device):
    master.set_outputs(0x55)
    assert device[0x6200, 1] == 0x55
    master.stop()
    assert device[0x6200, 1] == 0


def test_inputs_come_when_they_change(master, device):
    device[0x6000, 1] = 0x0F
    master.watch()
    assert master.inputs() == 0x0F


def test_a_device_that_falls_silent_is_lost(master, faults):
    faults.inject("heartbeat-off", node=1)
    with pytest.raises(DeviceLostError):
        master.watch()


def test_a_device_that_starts_again_is_lost(master, faults):
    faults.inject("reboot", node=1)
    with pytest.raises(DeviceLostError):
        master.watch()
