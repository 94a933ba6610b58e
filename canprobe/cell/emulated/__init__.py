"""The emulated side of a cell: its drives and its array, made of a plan and put on one plant.

- `world` makes the nodes from a plan, with a recorder of the truth and the names of its columns.
- `array` is the tactile node of a CANopen array, an array that knows no CANopen, and the processing of a raw image in
  the sensor before it is sent.
- `array_faults` are the faults of the array, beside those of `canprobe.fieldbus.tools.faults`.

The nodes are those of `canprobe.fieldbus`; the model behind them is `canprobe.cell.plant`, which they ask for positions
and images by time. The emulated side never imports the master's, nor the reverse: they know each other only by the bus,
and `session.direct` puts them together where there is none.
"""
