"""canopen-python's BaseNode402, used as its documentation and examples use it, as the master of one drive.

python base_node_402.py WAY NODE EDS CHANNEL

cyclic   CSP with a SYNC every 20 ms, the first RPDO started as a periodic message
direct   profile position; values are written, and the RPDO is left to BaseNode402
event    the same with the RPDO's transmission type set to 255 before
"""

import sys
import time

import canopen

way, node_id, eds, channel = sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4]
PERIOD_S = 0.02
network = canopen.Network()
network.connect(interface="socketcan", channel=channel)
node = canopen.BaseNode402(node_id, eds)
network.add_node(node)
node.sdo.RESPONSE_TIMEOUT = 2.0
node.nmt.state = "PRE-OPERATIONAL"
if way == "cyclic":
    node.sdo[0x60C2][1].raw, node.sdo[0x60C2][2].raw = round(PERIOD_S * 1e3), -3
if way == "event":
    node.sdo[0x1400][2].raw = 255
node.setup_402_state_machine()
node.op_mode = "CYCLIC SYNCHRONOUS POSITION" if way == "cyclic" else "PROFILED POSITION"
node.nmt.state = "OPERATIONAL"
network.sync.start(PERIOD_S)
try:
    if way == "cyclic":
        node.rpdo[1].start(PERIOD_S)
    node.state = "OPERATION ENABLED"
    for step in range(100):
        if way == "cyclic":
            node.rpdo_pointers[0x607A].raw = 20 * step
        time.sleep(PERIOD_S)
    node.state = "SWITCH ON DISABLED"
finally:
    node.rpdo[1].stop()
    network.sync.stop()
    network.disconnect()
