"""Plan → the emulated side: one plant, its nodes, and the recorder of what is true."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from canprobe.eds import FULL_SCALE, has_full_scale, load_eds
from canprobe.emulator.drive import make_drive_node
from canprobe.emulator.lss import set_serial_number
from canprobe.emulator.node import SlaveNode
from canprobe.emulator.plant.config import DynamicSettings, PlantConfig, PressMotion
from canprobe.emulator.plant.taxels import TaxelConfig
from canprobe.emulator.plant.world import Plant
from canprobe.emulator.tactile import make_tactile_node
from canprobe.emulator.truth import TruthRecorder
from canprobe.planning import Plan
from canprobe.planning.model import PlannedNode
from canprobe.protocol.lss import UNCONFIGURED
from canprobe.robot.kinematics import forward
from canprobe.robot.puma260 import MODELS, Array, PumaModel
from canprobe.robot.touching import start_posture
from canprobe.scene import TOUCH_KINDS, PlantSettings, ProbeSettings, Scene
from canprobe.scene_geometry import T_flange_probe, approach_normal, true_object

PARKED_ABOVE_MM = 5.0
"""How far above the approach's first point an emulated arm stands at power on."""
EFFECTS = ("noise", "gain_error", "blur", "hysteresis", "creep", "crosstalk", "saturation", "threshold")


@dataclass(frozen=True, slots=True)
class World:
    """The emulated nodes and what they share.

    Attributes:
        nodes: the slaves, ascending by node id.
        plant: arm, probe, object and array.
        recorder: notes the truth at every SYNC; None where nobody wants it, as it grows with time.
    """

    nodes: tuple[SlaveNode, ...]
    plant: Plant
    recorder: TruthRecorder | None

    @property
    def participants(self) -> tuple[SlaveNode | TruthRecorder, ...]:
        """Everything that lives on the bus; the recorder listens only."""
        return self.nodes if self.recorder is None else (*self.nodes, self.recorder)


def make_world(plan: Plan, node_ids: Collection[int], *, truth: bool = True, without_id: Collection[int] = ()) -> World:
    """The emulated nodes of a plan, behind one plant.

    Where the scene gives a node no serial number, its node id in the scene is one.

    Args:
        plan: of the scene.
        node_ids: which of its nodes to emulate.
        truth: whether what is true is recorded.
        without_id: which of them start without a node id and wait for LSS to give them one.
    """
    scene = plan.scene
    plant = Plant(_plant_config(scene))
    nodes = []
    for node in plan.nodes:
        if node.node_id not in node_ids:
            continue
        nodes.append(_node(scene, node, UNCONFIGURED if node.node_id in without_id else node.node_id, plant))
    return World(tuple(nodes), plant, TruthRecorder(plant) if truth else None)


def _node(scene: Scene, planned: PlannedNode, node_id: int, plant: Plant) -> SlaveNode:
    dictionary, od_of = load_eds(planned.eds, planned.node_id), partial(load_eds, planned.eds)
    if planned.kind == "drive":
        assert scene.arm is not None
        axis = scene.arm.node_ids.index(planned.node_id)
        node = make_drive_node(dictionary, node_id, axis, plant, od_of)
    else:
        assert scene.sensor is not None
        node = make_tactile_node(dictionary, node_id, plant, od_of=od_of)
        if has_full_scale(dictionary):
            node.dictionary.set_default(FULL_SCALE, 0, round(scene.sensor.full_scale_kpa * 1e3))
    serial = planned.identity.serial_number
    set_serial_number(node, planned.node_id if serial is None else serial)
    if node.lss is not None:
        node.lss.bitrate = scene.bus.bitrate
    return node


def _plant_config(scene: Scene) -> PlantConfig:
    settings, probe, arm = scene.plant or PlantSettings(), scene.probe or ProbeSettings(), scene.arm
    config = PlantConfig(
        model=MODELS[arm.model] if arm is not None else None,
        T_flange_probe_centre=_real_tool(probe, settings),
        radius_m=probe.radius_mm * 1e-3,
        stiffness_n_m3=settings.stiffness_n_m3 or probe.stiffness_n_m3,
        damping_s_m=settings.contact_damping_s_m,
        object=true_object(scene.object) if scene.object is not None else None,
        taxels=_taxels(scene, settings),
        bandwidth_hz=settings.drive_bandwidth_hz,
        press=PressMotion(force_n=scene.task.force_n),
        seed=scene.seed,
    )
    if arm is None:
        return config
    real = MODELS[settings.arm_model or arm.model]
    return replace(
        config,
        model=real,
        q0=_first_posture(scene),
        fidelity=settings.fidelity,
        dynamics=_dynamics(settings, probe),
        base_offset_m=_base_offset(scene, real),
    )


def _real_tool(probe: ProbeSettings, settings: PlantSettings) -> Array:
    """Where the probe's centre is on the flange, (4, 4), m: where the controller believes it, and an error."""
    T = T_flange_probe(probe)
    T[:3, 3] += np.array(settings.tool_error_mm) * 1e-3
    return T


def _dynamics(settings: PlantSettings, probe: ProbeSettings) -> DynamicSettings:
    return DynamicSettings(
        payload_kg=probe.mass_kg,
        friction=settings.friction,
        integral_s=settings.integral_ms * 1e-3,
        velocity_feed_forward=settings.velocity_feed_forward,
        torque_limit_permille=settings.torque_limit_permille,
        method=settings.integrator,
        step_ns=round(settings.step_us * 1000),
    )


def _base_offset(scene: Scene, real: PumaModel) -> Array:
    """Where the real arm's base stands in the controller's base frame, (3,), m.

    An experimenter moves the arm to the object and takes that place for what the encoders say: both arms hold the
    probe at one place in the first posture.
    """
    assert scene.arm is not None
    q, tool = _first_posture(scene), T_flange_probe(scene.probe or ProbeSettings())
    offset: Array = ((forward(MODELS[scene.arm.model], q) - forward(real, q)) @ tool)[:3, 3]
    return offset


def _first_posture(scene: Scene) -> Array:
    """Joint angles (6,), rad, at power on: above the start point of a touch, else as the scene says."""
    assert scene.arm is not None
    given = np.radians(scene.arm.start_deg)
    if scene.probe is None or scene.task.kind not in TOUCH_KINDS:
        return given
    return start_posture(
        MODELS[scene.arm.model],
        np.array(scene.task.start_mm) * 1e-3,
        approach_normal(scene.task),
        radius_m=scene.probe.radius_mm * 1e-3,
        T_flange_probe=T_flange_probe(scene.probe),
        clearance_m=(scene.task.clearance_mm + PARKED_ABOVE_MM) * 1e-3,
        q_near=given,
    )


def _taxels(scene: Scene, settings: PlantSettings) -> TaxelConfig | None:
    if scene.sensor is None:
        return None
    array = TaxelConfig(full_scale_pa=scene.sensor.full_scale_kpa * 1e3, adc_bits=settings.adc_bits)
    return array.without(*(effect for effect in EFFECTS if not getattr(settings, effect)))
