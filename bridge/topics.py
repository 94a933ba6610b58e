"""The topics that every ROS sink has in common: names, types, and the quality of service that ROS expects of them."""

from __future__ import annotations

from dataclasses import dataclass

from canprobe.bridge.cdr import CAN_FD_FRAME, CAN_FRAME


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic.

    Attributes:
        name: as ROS writes it.
        type_name: as rosbags and ROS write it.
        depth: of the history that is kept.
        transient: late readers get the last message (transient local).
        best_effort: a lost message is not sent again (sensor data); reliable otherwise.
    """

    name: str
    type_name: str
    depth: int = 10
    transient: bool = False
    best_effort: bool = False


JOINT_STATES = Topic("/joint_states", "sensor_msgs/msg/JointState")
WRENCH = Topic("/wrench", "geometry_msgs/msg/WrenchStamped")
TF = Topic("/tf", "tf2_msgs/msg/TFMessage", depth=100)
TF_STATIC = Topic("/tf_static", "tf2_msgs/msg/TFMessage", depth=1, transient=True)
TAXELS = Topic("/taxels/image", "sensor_msgs/msg/Image", depth=5, best_effort=True)
PATCH = Topic("/surface_patch", "sensor_msgs/msg/PointCloud2", depth=5)
CURVATURE = Topic("/curvature", "geometry_msgs/msg/Vector3Stamped")
CAN_FD_FRAMES = Topic("/can_fd_frames", CAN_FD_FRAME, depth=500)
CAN_FRAMES = Topic("/can_frames", CAN_FRAME, depth=500)
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")

TOPICS = (JOINT_STATES, WRENCH, TF, TF_STATIC, TAXELS, PATCH, CURVATURE, CAN_FRAMES, CAN_FD_FRAMES, DIAGNOSTICS)
