"""Sets the outputs of a CANopen I/O device (CiA 401), and reads its inputs.

python io_master.py NODE EDS INTERFACE CHANNEL
"""

import sys
import time

import canopen

HEARTBEAT_MS = 100
"""Period of the device's heartbeat."""
SILENCE_S = 0.5
"""The device counts as lost after so long without a heartbeat."""


class DeviceLostError(Exception):
    """The device does not send its heartbeat, or has started again by itself."""


class IoMaster:
    """The master of one device.

    Args:
        network: network of canopen-python.
        node_id: node id of the device.
        eds: EDS file of the device.
        sleep: function that waits, s.
    """

    def __init__(self, network, node_id, eds, sleep=time.sleep):
        self.node = network.add_node(node_id, eds)
        self.sleep = sleep
        self.heard = []
        self.node.nmt.add_heartbeat_callback(self.heard.append)

    def find(self, patience_s=10.0):
        """Ask the device until it answers; it may be there already, and then no boot-up comes."""
        for _ in range(round(patience_s / self.node.sdo.RESPONSE_TIMEOUT)):
            try:
                return self.node.sdo[0x1000].raw
            except canopen.SdoCommunicationError:
                continue
        raise DeviceLostError(f"node {self.node.id} does not answer within {patience_s} s")

    def start(self):
        """Configure the device while it is pre-operational, and start it."""
        node = self.node
        node.nmt.state = "PRE-OPERATIONAL"
        node.sdo[0x1017].raw = HEARTBEAT_MS
        node.tpdo.read()
        node.rpdo.read()
        node.nmt.state = "OPERATIONAL"
        self.watch()

    def watch(self):
        """Let the time pass in which the device must send its heartbeat; it must be operational."""
        self.heard.clear()
        self.sleep(SILENCE_S)
        if self.heard[-1:] != [0x05]:
            raise DeviceLostError(f"heartbeats within {SILENCE_S} s: {self.heard}, expected 5, operational, at last")

    def set_outputs(self, byte):
        """Set eight outputs by RPDO, and read them back."""
        outputs = self.node.rpdo[1]
        outputs[0].raw = byte
        outputs.transmit()
        self.watch()
        if (shown := self.node.sdo[0x6200][1].raw) != byte:
            raise RuntimeError(f"the outputs are {shown:02X}h, expected {byte:02X}h")

    def inputs(self):
        """Eight inputs, of the last TPDO: the device sends it when it starts, and when they change."""
        return self.node.tpdo[1][0].raw

    def stop(self):
        """Switch the outputs off, and stop the device."""
        self.set_outputs(0)
        self.node.nmt.state = "PRE-OPERATIONAL"


def main(node_id, eds, interface, channel):
    network = canopen.Network()
    network.connect(interface=interface, channel=channel)
    try:
        master = IoMaster(network, int(node_id), eds)
        master.find()
        master.start()
        master.set_outputs(0x55)
        print(f"inputs: {master.inputs():02X}h")
        master.stop()
    finally:
        network.disconnect()


if __name__ == "__main__":
    main(*sys.argv[1:])
