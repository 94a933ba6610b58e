"""Kinematics of contact, (13)–(23) of Chen, Rink and Zhang, that the contact of the package is held against."""

from __future__ import annotations

import math

import numpy as np

from canprobe.errors import UsageError
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation
from canprobe.mechanics.types import Floats


def probe_contact_frame(direction: Floats, radius: float) -> Floats:
    """T (4, 4) from the probe's contact frame (z = inward normal of the probe) to the probe frame."""
    return homogeneous(tangent_rotation(-direction), radius * direction)


def point_in_object(T_base_object: Floats, p_base: Floats) -> Floats:
    """The contact point in the object's frame (21), (22)."""
    T = np.linalg.inv(T_base_object)
    result: Floats = T[:3, :3] @ p_base + T[:3, 3]
    return result


def contact_orientation_in_object(
    T_base_object: Floats, T_base_probe: Floats, T_probe_cf: Floats, R_cf_co: Floats
) -> Floats:
    """Axes of the object's contact frame in the object's frame, `R_o_c = R_bᵀ R_s R_cf R_cf_co` (23)."""
    result: Floats = T_base_object[:3, :3].T @ T_base_probe[:3, :3] @ T_probe_cf[:3, :3] @ R_cf_co
    return result


def facing_rotation(spin: float = 0.0) -> Floats:
    """R (3, 3) from the object's to the probe's contact frame: z opposed, x turned by `spin` rad."""
    c, s = math.cos(spin), math.sin(spin)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def material_velocity(origin: Floats, origin_velocity: Floats, omega: Floats, point: Floats) -> Floats:
    """V: velocity of the point of a rigid body that is now at `point`."""
    return origin_velocity + np.cross(omega, point - origin)


def velocity_over_object(v_f: Floats, V_f: Floats, V_o: Floats) -> Floats:
    """v_o = v_f + V_f − V_o (17)–(19): how the contact point moves over the object."""
    return v_f + V_f - V_o


def normal_rate_residual(  # noqa: PLR0917 - the equation's own symbols in its order
    K_o: Floats, v_o: Floats, K_f: Floats, v_f: Floats, omega_f: Floats, omega_o: Floats, n_o: Floats
) -> Floats:
    """`K_o v_o + K_f v_f − (ω_f − ω_o) × n_o` (16): zero in a motion that keeps contact.

    Args:
        K_o, K_f: (3, 3) shape operators as tensors.
        v_o, v_f: (3,) velocities of the contact point over the object and over the probe, m/s.
        omega_f, omega_o: (3,) rad/s.
        n_o: (3,) outward unit normal of the object.
    """
    result: Floats = K_o @ v_o + K_f @ v_f - np.cross(omega_f - omega_o, n_o)
    return result


def contact_velocities(
    K_o: Floats, K_f: Floats, V_rel: Floats, omega_rel: Floats, n_o: Floats
) -> tuple[Floats, Floats]:
    """How the contact moves over both bodies when the motion is given: (16) and (19) solved together.

    Args:
        K_o, K_f: (3, 3) shape operators as tensors.
        V_rel: (3,) V_f − V_o, m/s; its normal part must be 0 for contact to last.
        omega_rel: (3,) ω_f − ω_o, rad/s; its part along the normal drops out.
        n_o: (3,) outward unit normal of the object.

    Returns:
        v_o, v_f (3,) m/s.

    Raises:
        UsageError: where K_o + K_f is singular on the tangent plane (surfaces that fit into each other).
    """
    P = tangent_rotation(-n_o)[:, :2]
    slide = V_rel - n_o * float(n_o @ V_rel)
    relative = P.T @ (K_o + K_f) @ P
    if abs(float(np.linalg.det(relative))) <= 1e-12 * float(np.abs(relative).max()) ** 2:
        raise UsageError("K_o + K_f: expected surfaces that touch at a point, got a singular relative curvature")
    v_f = P @ np.linalg.solve(relative, P.T @ (np.cross(omega_rel, n_o) - K_o @ slide))
    return v_f + slide, v_f


def sphere_tensor(radius: float, normal: Floats) -> Floats:
    """Shape operator (3, 3) of a sphere at the point with this unit normal, 1/m."""
    return (np.eye(3) - np.outer(normal, normal)) / radius


def skew(w: Floats) -> Floats:
    """The (3, 3) matrix of `w ×`."""
    x, y, z = float(w[0]), float(w[1]), float(w[2])
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
