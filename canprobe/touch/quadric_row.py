"""What `quadric.rows` makes of one sample, in plain floats: a twentieth of the time at this size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple


class SampleRows(NamedTuple):
    """Whitened rows of one sample.

    Attributes:
        weights: (12,) of three rows, one after the other: of f, f_x, f_y, f_z in the row of any term of f.
        residuals: three, their signs turned.
        place: x, y, z at which the sample most likely was: where the terms are to be taken.
    """

    weights: tuple[float, ...]
    residuals: tuple[float, float, float]
    place: tuple[float, float, float]


def sample_rows(
    c: Sequence[float], x: Sequence[float], n: Sequence[float], variances: tuple[float, float], coupling: float = 0.0
) -> SampleRows:
    """The rows of one sample with isotropic noise.

    Args:
        c: nine parameters in the order of `quadric`.
        x, n: point and outward normal in the working frame, dimensionless.
        variances: of point and normal per axis, dimensionless.
        coupling: `Noise.coupling`, dimensionless.
    """
    point_variance, normal_variance = variances
    c14, c24, c44, c13, c23, c33, c11, c12, c22 = c
    px, py, pz = x
    # value and gradient at the measured point, then at its foot
    gx = 2.0 * (c11 * px + c12 * py + c13 * pz + c14)
    gy = 2.0 * (c12 * px + c22 * py + c23 * pz + c24)
    gz = 2.0 * (c13 * px + c23 * py + c33 * pz) - 1.0
    square = gx * gx + gy * gy + gz * gz
    f = 0.5 * (px * (gx + 2.0 * c14) + py * (gy + 2.0 * c24) + pz * (gz - 1.0)) + c44
    k = f / square
    r0 = f / math.sqrt(square)
    px, py, pz = px - k * gx, py - k * gy, pz - k * gz
    hx, hy, hz, inverse = _unit_gradient(c, px, py, pz)
    # tangent axes of the measured normal
    nx, ny, nz = n
    size = math.sqrt(nz * nz + nx * nx)
    ax, az = nz / size, -nx / size
    bx, by, bz = -ny * nx / size, size, -ny * nz / size
    ra, rb = ax * hx + az * hz, bx * hx + by * hy + bz * hz
    # 2 S3 along the axes, and on them the shape operator with the coupling
    ux, uy, uz = 2 * (c11 * ax + c13 * az), 2 * (c12 * ax + c23 * az), 2 * (c13 * ax + c33 * az)
    wx = 2 * (c11 * bx + c12 * by + c13 * bz)
    wy = 2 * (c12 * bx + c22 * by + c23 * bz)
    wz = 2 * (c13 * bx + c23 * by + c33 * bz)
    k11 = (ax * ux + az * uz) * inverse + coupling
    k12 = (bx * ux + by * uy + bz * uz) * inverse
    k22 = (bx * wx + by * wy + bz * wz) * inverse + coupling
    bend_a = (hx * ux + hy * uy + hz * uz) * inverse
    bend_b = (hx * wx + hy * wy + hz * wz) * inverse
    # whitening: Cholesky of σ_n² I + K² σ_p²
    l11 = math.sqrt(normal_variance + point_variance * (k11 * k11 + k12 * k12))
    l21 = point_variance * k12 * (k11 + k22) / l11
    l22 = math.sqrt(normal_variance + point_variance * (k12 * k12 + k22 * k22) - l21 * l21)
    w0 = 1.0 / math.sqrt(point_variance)
    ra /= l11
    rb = (rb - l21 * ra) / l22
    # where the sample most likely was
    sb = rb / l22
    sa = (ra - l21 * sb) / l11
    ea, eb = point_variance * (k11 * sa + k12 * sb), point_variance * (k12 * sa + k22 * sb)
    px, py, pz = px - ea * ax - eb * bx, py - eb * by, pz - ea * az - eb * bz
    hx, hy, hz, inverse = _unit_gradient(c, px, py, pz)
    # Jacobian there; the tangent axes lose their part along the model's normal
    t = ax * hx + az * hz
    ax, ay, az = ax - t * hx, -t * hy, az - t * hz
    t = bx * hx + by * hy + bz * hz
    bx, by, bz = bx - t * hx, by - t * hy, bz - t * hz
    s0, sa, sb, m = w0 * inverse, inverse / l11, inverse / l22, l21 / l22
    a0, a1, a2, a3 = -sa * bend_a, sa * ax, sa * ay, sa * az
    b0, b1, b2, b3 = -sb * bend_b - m * a0, sb * bx - m * a1, sb * by - m * a2, sb * bz - m * a3
    weights = s0, 0.0, 0.0, 0.0, a0, a1, a2, a3, b0, b1, b2, b3
    return SampleRows(weights, (-w0 * r0, -ra, -rb), (px, py, pz))


def _unit_gradient(c: Sequence[float], px: float, py: float, pz: float) -> tuple[float, float, float, float]:
    """∇f/|∇f| and 1/|∇f|."""
    c14, c24, _, c13, c23, c33, c11, c12, c22 = c
    gx = 2.0 * (c11 * px + c12 * py + c13 * pz + c14)
    gy = 2.0 * (c12 * px + c22 * py + c23 * pz + c24)
    gz = 2.0 * (c13 * px + c23 * py + c33 * pz) - 1.0
    inverse = 1.0 / math.sqrt(gx * gx + gy * gy + gz * gz)
    return gx * inverse, gy * inverse, gz * inverse, inverse
