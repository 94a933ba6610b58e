"""A cell in three dimensions: live in a browser, a recorded run with a time slider, one file to share.

Shapes, colours and what is read from a run are plain numpy; only ``stage`` imports viser, and only ``stage``, ``path``
and ``browser`` speak to it; ``links`` reads the meshes of a URDF with trimesh. The extra ``view`` installs both.
"""
