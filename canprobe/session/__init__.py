"""The composition root: a cell with everything round it, the emulated nodes and bridges in their processes."""
