"""The other side of the bus: CiA 301 nodes driven by an EDS, the drives, the tactile node, and how they are served.

A node takes bytes and a time and gives bytes and its next deadline; it never sleeps, opens or waits. So the same
nodes run in virtual time inside one process, and on a real interface for any master.

- `node/` is the CiA 301 engine, configured by an EDS alone. `drive/` is a CiA 402 drive on it, `array` the tactile
  node.
- `plant/` is the pure model behind them: arm, contact, taxels. The nodes ask it for positions and images by time.
- `world` makes all of it from a plan, with a recorder of what is true; or a node from any EDS file.
- `faults` injects faults into a node; `serve` serves nodes on a real interface and keeps what a master stores in
  them.

The emulator never imports the cell, nor the reverse: they know each other only by the bus, and `session.direct` puts
them together where there is none. Each point of the conformance list is a test named after its clause.
"""
