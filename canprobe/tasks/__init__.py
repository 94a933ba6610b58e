"""Controllers: what a cell does in each cycle, from a measurement to a command."""
