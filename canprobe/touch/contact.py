"""Contact of a spherical probe with an object: places, normals and rates.

Signs. Body f is the probe ("finger"), body o the object. `n_f`, `n_o` are OUTWARD unit normals, `n_f = -n_o` (14).
K is a shape operator, here as a 3x3 tensor on the tangent plane, positive for convex, so that a point moving over a
fixed body with velocity v turns its outward normal by `K v`. `V` is the velocity of the material point of a body at
the contact, `v` that of the contact point over the body, `ω` angular velocity. All in one frame, usually base.

    common position   v_o = v_f + V_f - V_o                          (17)–(19)
    common normal     K_o v_o + K_f v_f = (ω_f - ω_o) × n_o          (16), for unit normals

Source: Chen, Rink and Zhang (13)–(23). The paper writes 2S for K, right only where |∇f| = 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from canprobe.errors import UsageError
from canprobe.touch._arrays import Array, positive
from canprobe.touch.frames import cross, homogeneous, inverse_transform, tangent_rotation


class Doubt(Enum):
    """Why a contact's place is worth less than others."""

    SATURATED = "a saturated patch"
    CUT = "a patch cut by the pad's edge"
    SMALL = "hardly a patch"
    DEAD = "a dead taxel in the patch"


@dataclass(frozen=True, slots=True, eq=False)
class ContactSample:
    """One touch, as the estimators take it.

    Attributes:
        t_s: time, s.
        p_base: (3,) contact point on the object, m, in base.
        n_base: (3,) outward unit normal of the object there, in base.
        T_base_probe: (4, 4) probe frame (origin at the sphere's centre, z through the pole of the pad) to base.
        r_probe: (3,) contact point in the probe frame, m.
        force_n: contact force, N.
        sigma_point: effective standard deviation of the point per axis, m; None for the estimator's own.
        sigma_normal: that of the normal per tangent axis, rad; None for the estimator's own.
        moments: second moments uu, uv, vv of the patch along the pad's axes, m² (`patch_image`); None for none.
        doubts: about the image; estimators give the contact less weight and say so.
    """

    t_s: float
    p_base: Array
    n_base: Array
    T_base_probe: Array
    r_probe: Array
    force_n: float
    sigma_point: float | None = None
    sigma_normal: float | None = None
    moments: tuple[float, float, float] | None = None
    doubts: tuple[Doubt, ...] = ()


def pad_to_direction(u: float, v: float, radius: float) -> Array:
    """Direction of a pad point as seen from the sphere's centre, in the probe frame.

    The flat array is wrapped azimuthal-equidistantly: the exponential map of (u, v)/R_p at the pole.

    Args:
        u, v: pad coordinates along the probe's x and y, m.
        radius: R_p, m.

    Returns:
        (3,) unit vector.
    """
    angle = math.hypot(u, v) / radius
    scale = 1.0 / radius if angle < 1e-9 else math.sin(angle) / (angle * radius)
    return np.array([u * scale, v * scale, math.cos(angle)])


def direction_to_pad(direction: Sequence[float] | Array, radius: float) -> tuple[float, float]:
    """Pad coordinates (u, v) in m of a direction (3,) in the probe frame: the logarithmic map at the pole."""
    x, y, z = float(direction[0]), float(direction[1]), float(direction[2])
    sine = math.hypot(x, y)
    scale = radius if sine < 1e-12 and z > 0.0 else radius * math.atan2(sine, z) / max(sine, 1e-300)
    return x * scale, y * scale


def probe_contact_frame(direction: Array, radius: float) -> Array:
    """T (4, 4) from the probe's contact frame (z = inward normal of the probe) to the probe frame."""
    return homogeneous(tangent_rotation(-direction), radius * direction)


def contact_on_object(T_base_probe: Array, direction: Array, radius: float, depth: float) -> tuple[Array, Array]:
    """The object's contact point and outward normal in base, through the squeezed layer (13), (14), (20).

    Args:
        T_base_probe: (4, 4) probe frame to base.
        direction: (3,) unit, from the sphere's centre to the contact, in the probe frame.
        radius: R_p of the unloaded probe, m.
        depth: indentation δ of the layer, m.

    Returns:
        `p = centre + (R_p - δ) n_f` and `n_o = -n_f`, (3,) each.
    """
    u, v, w = direction.tolist()
    (a, b, c, x), (d, e, f, y), (g, h, i, z), _ = T_base_probe.tolist()
    nx, ny, nz = a * u + b * v + c * w, d * u + e * v + f * w, g * u + h * v + i * w
    reach = radius - depth
    return np.array([x + reach * nx, y + reach * ny, z + reach * nz]), np.array([-nx, -ny, -nz])


def contact_sample(
    *,
    t_s: float,
    T_base_probe: Array,
    uv: Sequence[float] | Array,
    depth: float,
    radius: float,
    force_n: float,
    moments: tuple[float, float, float] | None = None,
    doubts: tuple[Doubt, ...] = (),
) -> ContactSample:
    """A sample from the centroid on the pad: the whole way from taxels to base.

    Args:
        t_s: time at which taxels and pose hold, s.
        T_base_probe: (4, 4) probe frame to base at that time.
        uv: (2,) centroid on the pad, m.
        depth: indentation, m (`indentation_from_force`).
        radius: R_p, m.
        force_n: N.
        moments: of the patch, m².
        doubts: about the image.
    """
    u, v = uv
    direction = pad_to_direction(u, v, radius)
    point, normal = contact_on_object(T_base_probe, direction, radius, depth)
    arm = (radius - depth) * direction
    return ContactSample(t_s, point, normal, T_base_probe, arm, force_n, moments=moments, doubts=doubts)


def point_in_object(T_base_object: Array, p_base: Array) -> Array:
    """The contact point in the object's frame (21), (22)."""
    T = inverse_transform(T_base_object)
    result: Array = T[:3, :3] @ p_base + T[:3, 3]
    return result


def contact_orientation_in_object(
    T_base_object: Array, T_base_probe: Array, T_probe_cf: Array, R_cf_co: Array
) -> Array:
    """Axes of the object's contact frame in the object's frame, `R_o_c = R_bᵀ R_s R_cf R_cf_co` (23)."""
    result: Array = T_base_object[:3, :3].T @ T_base_probe[:3, :3] @ T_probe_cf[:3, :3] @ R_cf_co
    return result


def facing_rotation(spin: float = 0.0) -> Array:
    """R (3, 3) from the object's to the probe's contact frame: z opposed, x turned by `spin` rad."""
    c, s = math.cos(spin), math.sin(spin)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def material_velocity(origin: Array, origin_velocity: Array, omega: Array, point: Array) -> Array:
    """V: velocity of the point of a rigid body that is now at `point`."""
    return origin_velocity + cross(omega, point - origin)


def velocity_over_object(v_f: Array, V_f: Array, V_o: Array) -> Array:
    """v_o = v_f + V_f − V_o (17)–(19): how the contact point moves over the object."""
    return v_f + V_f - V_o


def normal_rate_residual(  # noqa: PLR0917 - the equation's own symbols in its order
    K_o: Array, v_o: Array, K_f: Array, v_f: Array, omega_f: Array, omega_o: Array, n_o: Array
) -> Array:
    """`K_o v_o + K_f v_f − (ω_f − ω_o) × n_o` (16): zero in a motion that keeps contact.

    Args:
        K_o, K_f: (3, 3) shape operators as tensors.
        v_o, v_f: (3,) velocities of the contact point over the object and over the probe, m/s.
        omega_f, omega_o: (3,) rad/s.
        n_o: (3,) outward unit normal of the object.
    """
    result: Array = K_o @ v_o + K_f @ v_f - cross(omega_f - omega_o, n_o)
    return result


def contact_velocities(K_o: Array, K_f: Array, V_rel: Array, omega_rel: Array, n_o: Array) -> tuple[Array, Array]:
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
    v_f = P @ np.linalg.solve(relative, P.T @ (cross(omega_rel, n_o) - K_o @ slide))
    return v_f + slide, v_f


def sphere_tensor(radius: float, normal: Array) -> Array:
    """Shape operator (3, 3) of a sphere at the point with this unit normal, 1/m."""
    return (np.eye(3) - np.outer(normal, normal)) / radius


def indentation_from_force(force: float, stiffness_n_m3: float, radius: float, kappa: ArrayLike) -> float:
    """Indentation of the elastic layer under a force.

    Winkler layer, `p = k (δ − A x² − B y²)₊`, hence `F = π k δ² / (2 √(AB))` with `A, B = ½ (1/R_p + κ1,2)`.

    Args:
        force: N; 0 or less gives 0.
        stiffness_n_m3: k = K/h, N/m³.
        radius: R_p, m.
        kappa: (2,) principal curvatures of the object, 1/m; a NaN (not observed) counts as flat.

    Returns:
        δ in m.

    Raises:
        UsageError: where the object is concave and as tight as the probe or tighter: there is no patch.
    """
    k1, k2 = (0.0 if math.isnan(k) else float(k) for k in np.asarray(kappa, dtype=np.float64))
    positive("stiffness_n_m3", stiffness_n_m3)
    ab = (0.5 / radius + 0.5 * k1) * (0.5 / radius + 0.5 * k2)
    if min(1.0 / radius + k1, 1.0 / radius + k2) <= 0.0:
        raise UsageError(f"kappa: expected above {-1.0 / radius:.4g} per m (the probe's own curvature), got {k1}, {k2}")
    return math.sqrt(max(force, 0.0) * 2.0 * math.sqrt(ab) / (math.pi * stiffness_n_m3))
