"""The other side of the bus: CiA 301 nodes driven by an EDS, the drive, the tactile node, and how they are served.

A node takes bytes and a time and gives bytes and its next deadline; it never sleeps, opens or waits. `node/` is the
CiA 301 engine, `drive/` and `array` are what stands on it, `plant/` is the pure model behind the nodes.
"""
