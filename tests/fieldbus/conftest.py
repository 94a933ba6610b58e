"""What tests of nodes and drives share."""

from node_bench import bench, drive, make_bench, plant, rig, tiny_od  # noqa: F401
