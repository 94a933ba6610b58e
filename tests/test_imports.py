"""The wings and rooms of the package: who may import whom, read from the source; no circles.

    fieldbus   protocol < eds < bus < node < drive < motor < tools; vcan          neither numpy nor scipy
    mechanics  types < robot < touch
    cell       scene < planning < master < tasks | plant < emulated, then session < results < recorded
    lab        bridge, studies, gym, examples

`fieldbus` and `mechanics` know nothing of each other nor of what is above; `cell` knows both; `lab` and `cli` know all.
"""

import ast
import functools
import glob
import importlib
import sys
from pathlib import Path

import pytest

import canprobe

PACKAGE = Path(canprobe.__file__).parent
FILES = glob.glob("**/*.py", root_dir=PACKAGE, recursive=True)  # it follows the links eds and bridge; rglob does not
MODULES = {PACKAGE / name: Path(name) for name in sorted(FILES)}

WINGS = {
    "fieldbus": ("protocol", "eds", "bus", "node", "drive", "motor", "tools", "vcan"),
    "mechanics": ("types", "robot", "touch"),
    "cell": (
        "npz",
        "rows",
        "scene",
        "planning",
        "master",
        "tasks",
        "plant",
        "emulated",
        "session",
        "results",
        "recorded",
    ),
    "lab": ("bridge", "studies", "gym", "examples"),
}
WING_OF = {room: wing for wing, rooms in WINGS.items() for room in rooms} | {wing: wing for wing in WINGS}

# room → rooms of this package that it may import, besides itself, the doors of their wings and errors
BUS = {"protocol", "eds", "bus"}
MECHANICS = {"types", "robot", "touch"}
SCENE = {"protocol", "eds", "node", *MECHANICS, "npz", "scene"}
PLANNING = SCENE | {"planning", "bus"}
MASTER = PLANNING | {"master", "tasks", "npz", "rows"}
BOTH = MASTER | {"drive", "motor", "tools", "plant", "emulated", "session"}
ALLOWED = {
    "errors": set(),
    "protocol": set(),
    "eds": {"protocol"},
    "bus": {"protocol", "eds"},
    "node": BUS,
    "drive": BUS | {"node"},
    "motor": {"protocol", "bus"},
    "tools": BUS | {"node", "drive", "motor"},
    "vcan": {"bus"},
    "types": set(),
    "robot": {"types"},
    "touch": {"types", "robot"},
    "npz": {"bus"},
    "rows": set(),
    "scene": SCENE,
    "planning": PLANNING,
    "master": MASTER - {"tasks"},
    "tasks": MASTER,
    "plant": SCENE | {"drive"},
    "emulated": PLANNING | {"drive", "tools", "plant", "npz", "rows"},
    "session": BOTH,
    "results": BOTH,
    "recorded": BOTH | {"results"},
    "bridge": BOTH | {"results", "recorded"},
    "api": BOTH | {"results"},
    "testing": BOTH | {"results"},
    "gym": BOTH | {"api"},
    "studies": BOTH | {"results", "recorded", "api"},
    "cli": BOTH | {"results", "recorded", "api", "studies", "bridge", "vcan"},
    "examples": {"package", "api", "gym"},
    "package": {*MASTER, "api", "cli", "session", "results", "recorded", "studies"},
    **{wing: set() for wing in WINGS},  # the doors
}
ROOT = {"__init__", "__main__", "api", "errors", "testing"}
# module → packages of its extra; it is imported only where the extra is asked for
EXTRAS = {
    "testing.py": {"pytest"},
    "cell/results/lerobot.py": {"pyarrow", "pandas"},
    "lab/bridge/messages.py": {"rosbags"},
    "lab/bridge/mcap_file.py": {"mcap"},
    "lab/bridge/foxglove_live.py": {"foxglove"},
    "lab/bridge/ros2_dds.py": {"cyclonedds"},
    "lab/bridge/dds_types.py": {"cyclonedds", "rosbags"},
    "lab/bridge/view/stage.py": {"viser"},
    "lab/bridge/view/links.py": {"trimesh"},
    "cli/completion.py": {"argcomplete"},
    "cli/console_screen.py": {"textual", "rich"},
    "cell/results/picture.py": {"matplotlib"},
    "mechanics/robot/dynamics.py": {"mujoco"},
    "cell/scene/surface_files.py": {"trimesh"},
    "lab/studies/many.py": {"pandas", "xarray"},
    "cell/results/figures.py": {"matplotlib"},
    "cell/results/plan_figure.py": {"matplotlib"},
    "cell/results/surface_figure.py": {"matplotlib", "mpl_toolkits"},  # of the same distribution
    "lab/gym/__init__.py": {"gymnasium"},
    "lab/gym/env.py": {"gymnasium"},
    "lab/examples/learn_touch_scan.py": {"gymnasium"},
    "lab/gym/observations.py": {"gymnasium"},
}

EDGE_ONLY = {"time", "socket", "threading", "can", "selectors", "asyncio", "sched"}
AT_THE_EDGE = {"bus", "tools", "vcan"}
SERVES_OTHERS = {"lab/bridge/front.py", "lab/bridge/ros2_dds.py"}
"""Modules of a bridge's own process that hold its sockets; the cell does not import them."""
SPEAKS_TO_ARMS = {"cell/session/arm_socket.py"}
"""An arm that is not on the bus has an edge of its own, which the session opens beside the bus."""
NUMERIC = {"numpy", "scipy"}
NEVER_IN_PURE = EDGE_ONLY | {
    "canopen",
    "os",
    "subprocess",
    "logging",
    "multiprocessing",
    "signal",
    "ctypes",
    "datetime",
}
PURE_LAYERS = {"protocol", "types", "robot", "touch", "plant"}


NAMING = "import_module"


def layer_of(parts):
    """The room of a module, from the parts of its path or dotted name below the package."""
    top = parts[0] if parts else "package"
    if top in WINGS and len(parts) > 1 and parts[1] in WINGS[top]:
        return parts[1]
    return "package" if top in ("__init__", "__main__") else top


@functools.cache
def read(path):
    """What the tests here ask of a module, parsed once: imports, those for types alone, `import_module`s, classes.

    Whole names that `import_module` gets; one that is put together is what a user asks for, such as a command.
    """
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
    guarded = [n for n in nodes if isinstance(n, ast.If) and "TYPE_CHECKING" in ast.unparse(n.test)]
    for_types = {inner for node in guarded for statement in node.body for inner in ast.walk(statement)}
    calls = [
        n for n in nodes if isinstance(n, ast.Call) and getattr(n.func, "attr", getattr(n.func, "id", "")) == NAMING
    ]
    by_name = [arg.value for call in calls for arg in call.args if isinstance(arg, ast.Constant)]
    classes = [node.name for node in nodes if isinstance(node, ast.ClassDef)]
    return imports, for_types.intersection(imports), by_name, classes


def imports_of(path, relative, *, typed=False):
    """Dotted names that a module imports, absolute, with the line; `typed`: those for types alone, too."""
    imports, for_types, *_ = read(path)
    package = ["canprobe", *relative.parent.parts]
    for node in imports:
        if node in for_types and not typed:
            continue
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno, None) for alias in node.names)
        else:
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((_resolved(module, alias.name), node.lineno, alias.name) for alias in node.names)


def imported_by_name(path):
    return read(path)[2]


def _resolved(module, name):
    """`from canprobe import api` names a module, `from canprobe.api import run` a thing in one."""
    below = module.split(".")[1:]
    folder = PACKAGE.joinpath(*below)
    is_module = module.startswith("canprobe") and ((folder / f"{name}.py").is_file() or (folder / name).is_dir())
    return f"{module}.{name}" if is_module else module


def test_imports_point_downward():
    assert [wrong for path, relative in MODULES.items() for wrong in pointing_elsewhere(path, relative)] == []


def pointing_elsewhere(path, relative):
    """What a module imports and its layer may not, with file and line."""
    layer = layer_of(relative.with_suffix("").parts)
    wrong = []
    for name, line, what in imports_of(path, relative):
        top, *below = name.split(".")
        if top == "canprobe":
            target = layer_of(below)
            if target == WING_OF.get(layer):  # its own door
                fine = True
            elif target == "package":
                fine = layer in ("cli", "studies", "bridge", "api", "examples", "package") or what == "__version__"
            else:
                fine = target in {layer, "errors"} | ALLOWED[layer]
        elif WING_OF.get(layer) == "fieldbus" and top in NUMERIC:
            fine = False
        elif layer in PURE_LAYERS:
            fine = top not in NEVER_IN_PURE
        elif layer == "studies" and top == "time":
            fine = what in ("perf_counter", "process_time")
        else:
            fine = layer in AT_THE_EDGE or str(relative) in SERVES_OTHERS | SPEAKS_TO_ARMS or top not in EDGE_ONLY
        if not fine:
            wrong.append(f"{relative}:{line} imports {name}")
    return wrong


def test_nothing_imports_the_bridges_but_a_command_that_is_asked_for_one():
    assert [layer for layer, allowed in ALLOWED.items() if "bridge" in allowed] == ["cli"]
    for path, relative in MODULES.items():
        if layer_of(relative.with_suffix("").parts) == "cli":
            tree = ast.parse(path.read_text(encoding="utf-8"))
            at_the_top = [node.module for node in tree.body if isinstance(node, ast.ImportFrom)]
            assert not [name for name in at_the_top if name.startswith("canprobe.lab.bridge")], relative


def test_every_module_belongs_to_a_room():
    assert {layer_of(relative.with_suffix("").parts) for relative in MODULES.values()} <= set(ALLOWED)


def test_the_root_holds_four_modules_and_no_room_has_the_name_of_a_function():
    assert {relative.stem for relative in MODULES.values() if relative.parent == Path(".")} == ROOT
    assert not {"plan", "run", "replay"} & {part for relative in MODULES.values() for part in relative.parent.parts}


@pytest.mark.parametrize("typed", [False, True], ids=["run", "types"])
def test_no_modules_import_each_other_in_a_circle(typed):
    names = {path: ".".join(("canprobe", *relative.with_suffix("").parts)) for path, relative in MODULES.items()}
    names = {path: name.removesuffix(".__init__") for path, name in names.items()}
    known = set(names.values())
    graph = {}
    for path, name in names.items():
        targets = {target for target, _, _ in imports_of(path, MODULES[path], typed=typed)} & known
        targets |= {*imported_by_name(path)} & known
        graph[name] = targets - {name, "canprobe"}
    while leaves := {name for name, targets in graph.items() if not targets & set(graph)}:
        graph = {name: targets for name, targets in graph.items() if name not in leaves}
    while tops := set(graph) - {target for targets in graph.values() for target in targets}:
        graph = {name: targets for name, targets in graph.items() if name not in tops}
    assert not graph, {name: sorted(targets & set(graph)) for name, targets in graph.items()}


def test_no_class_has_the_name_of_another():
    places = {}
    for path, relative in MODULES.items():
        for name in read(path)[3]:
            places.setdefault(name, []).append(str(relative))
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


@pytest.mark.parametrize(
    "door",
    [
        "canprobe",
        *("canprobe.fieldbus", "canprobe.fieldbus.node", "canprobe.fieldbus.drive", "canprobe.fieldbus.tools"),
        *("canprobe.mechanics", "canprobe.mechanics.touch"),
    ],
)
def test_every_public_name_of_a_door_can_be_had(door):
    module = importlib.import_module(door)
    assert [name for name in module.__all__ if not hasattr(module, name)] == []
    assert not hasattr(module, "no_such_name")


def test_only_declared_packages_are_imported():
    """Base dependencies everywhere; an extra's package only in studies, and in the one module that needs it."""
    base = {"can", "canopen", "numpy", "scipy"}
    for path, relative in MODULES.items():
        extras = {"matplotlib"} if layer_of(relative.with_suffix("").parts) == "studies" else set()
        extras |= EXTRAS.get(str(relative), set())
        for name, line, _ in imports_of(path, relative):
            top = name.split(".")[0]
            known = top in sys.stdlib_module_names or top in base | extras | {"canprobe"}
            assert known, f"{relative}:{line} imports {name}"
