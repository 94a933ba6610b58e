"""How pytest loads the plugin of this package: by its entry point, or by name where only the folder is on the path."""

from importlib.metadata import entry_points

PLUGINS = [] if entry_points(group="pytest11", name="canprobe") else ["canprobe.testing"]
ARGUMENTS = [word for name in PLUGINS for word in ("-p", name)]
