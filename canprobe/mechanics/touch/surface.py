"""The matrix of a second-order surface: `f(X) = Xᵀ S X = 0` with `X = [x, y, z, 1]`.

f < 0 inside the body. A contact frame has its origin on the surface and **z along the inward normal**. S and any
positive multiple of it are the same surface; in its own contact frame a surface is normalised to
`c14 = c24 = c44 = 0, c34 = -1/2`, so that ‖∇f‖ = 1 there and `K = 2 [[c11, c12], [c12, c22]]` is its shape operator:
principal curvatures are positive where the body is convex.

Source: Chen, Rink and Zhang, "Local object shape from tactile sensing", (1)–(12). (2) lacks a factor 2 on `c34 z`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from canprobe.errors import UsageError
from canprobe.mechanics.touch.checks import MAX_MAGNITUDE, checked, instance, read_only, real
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation
from canprobe.mechanics.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMatrix:
    """A quadric surface in some frame.

    Attributes:
        S: (4, 4) symmetric, read-only; entries of the quadratic part in 1/m when ‖∇f‖ = 1.

    Raises:
        UsageError: when S is not a finite symmetric 4x4 matrix.
    """

    S: Floats

    def __post_init__(self) -> None:
        S = checked("S", self.S, (4, 4))
        if np.abs(S - S.T).max() > 1e-9 * max(float(np.abs(S).max()), 1e-300):
            raise UsageError(f"S: expected a symmetric matrix, got one with |S - Sᵀ| up to {np.abs(S - S.T).max():.3g}")
        if 0.0 < (size := float(np.abs(S).max())) < 1.0 / MAX_MAGNITUDE:
            raise UsageError(f"S: expected entries of at least {1.0 / MAX_MAGNITUDE:g} in size, got at most {size:g}")
        object.__setattr__(self, "S", read_only(0.5 * (S + S.T)))

    @classmethod
    def plane(cls) -> SurfaceMatrix:
        """A plane in its contact frame."""
        return cls.from_curvature(np.zeros((2, 2)))

    @classmethod
    def sphere(cls, radius: float) -> SurfaceMatrix:
        """A sphere in its contact frame.

        Args:
            radius: radius, m; negative for the inside of a spherical bowl.
        """
        k = 1.0 / _nonzero("radius", radius)
        return cls.from_curvature(k * np.eye(2), c33=0.5 * k)

    @classmethod
    def cylinder(cls, radius: float, axis: str | float = "y") -> SurfaceMatrix:
        """A circular cylinder in its contact frame.

        Args:
            radius: radius, m; negative for the inside of a tube.
            axis: direction of the centre line in the tangent plane, "x", "y" or an angle from x in rad.
        """
        named = {"x": (0.0, 1.0), "y": (1.0, 0.0)}
        if isinstance(axis, str):
            if axis not in named:
                raise UsageError(f'axis: expected "x", "y" or an angle in rad, got {axis!r}')
            across = named[axis]
        else:
            angle = float(checked("axis", axis, ()))
            across = -math.sin(angle), math.cos(angle)
        k = 1.0 / _nonzero("radius", radius)
        return cls.from_curvature(k * np.outer(across, across), c33=0.5 * k)

    @classmethod
    def from_curvature(cls, K: ArrayLike, c13: float = 0.0, c23: float = 0.0, c33: float = 0.0) -> SurfaceMatrix:
        """The normalised surface with shape operator K (2, 2) at the origin of its contact frame, 1/m.

        c13, c23, c33 (1/m) are the entries that K leaves open.
        """
        k = checked("K", K, (2, 2))
        others = checked("c13, c23, c33", [c13, c23, c33], (3,))
        S = np.zeros((4, 4))
        S[:2, :2] = 0.5 * k
        S[:2, 2] = S[2, :2] = others[:2]
        S[2, 2] = others[2]
        S[2, 3] = S[3, 2] = -0.5
        return cls(S)

    def __add__(self, other: SurfaceMatrix) -> SurfaceMatrix:
        """The sum of the two polynomials (7).

        The zero set of a sum is neither body nor their union: it passes through the curve that both surfaces share.
        Of two surfaces normalised in one contact frame the sum is the blend whose curvature there is the mean of the
        two; scaling gives other weights (`0.25 * a + 0.75 * b`).
        """
        return SurfaceMatrix(self.S + instance("sum", other, SurfaceMatrix).S)

    def __sub__(self, other: SurfaceMatrix) -> SurfaceMatrix:
        """The difference of the two polynomials (7): zero where both have the same value, no body by itself."""
        return SurfaceMatrix(self.S - instance("difference", other, SurfaceMatrix).S)

    def __mul__(self, factor: float) -> SurfaceMatrix:
        """The polynomial times a number; a positive one leaves the surface what it was."""
        return SurfaceMatrix(float(checked("factor", factor, ())) * self.S)

    __rmul__ = __mul__

    def transformed(self, T: ArrayLike) -> SurfaceMatrix:
        """The same surface in new coordinates, `S' = Tᵀ S T` (8), exact.

        Args:
            T: (4, 4) transform that takes new coordinates to the present ones.
        """
        matrix = checked("T", T, (4, 4))
        S = matrix.T @ self.S @ matrix
        return SurfaceMatrix(0.5 * (S + S.T))

    def value(self, points: ArrayLike) -> Floats:
        """f at points (…, 3); negative inside the body."""
        p = _places(points)
        result: Floats = np.einsum("...i,...i->...", p @ self.S[:3, :3] + 2.0 * self.S[:3, 3], p) + self.S[3, 3]
        return result

    def gradient(self, points: ArrayLike) -> Floats:
        """∇f = 2 (S X)₁..₃ at points (…, 3); points outward."""
        return 2.0 * (_places(points) @ self.S[:3, :3] + self.S[:3, 3])

    def normal(self, points: ArrayLike) -> Floats:
        """Outward unit normal (…, 3) at points (…, 3), of the level set through the point (12)."""
        g = self.gradient(points)
        result: Floats = g / np.sqrt(np.einsum("...i,...i->...", g, g))[..., None]
        return result

    def normalised_at(self, point: ArrayLike) -> SurfaceMatrix:
        """The same surface scaled to ‖∇f‖ = 1 at a point (3,).

        Raises:
            UsageError: where the gradient vanishes.
        """
        return SurfaceMatrix(self.S / self._gradient_size(point))

    def curvature_at(self, point: ArrayLike) -> tuple[Floats, Floats]:
        """Shape operator at a point of the surface.

        Args:
            point: (3,) point on the surface, m.

        Returns:
            The shape operator (2, 2) in 1/m, positive where convex, and its tangent basis (3, 2), the x and y axes of
            `contact_frame(point)`.
        """
        basis = self.contact_frame(point)[:3, :2]
        K = basis.T @ (2.0 * self.S[:3, :3]) @ basis / self._gradient_size(point)
        return 0.5 * (K + K.T), basis

    def contact_frame(self, point: ArrayLike) -> Floats:
        """T (4, 4) from the contact frame at a point to this frame: z is the inward normal.

        The x axis is this frame's x axis laid on the tangent plane (`tangent_frames.tangent_rotation`).
        """
        p = checked("point", point, (3,))
        return homogeneous(tangent_rotation(-self.gradient(p) / self._gradient_size(p)), p)

    def height(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """z of the surface over (x, y), the root that is 0 at the contact; NaN where there is none.

        Args:
            x, y: places, m, in a contact frame (or any frame where the z axis crosses the surface near the origin).

        Returns:
            z, m, in the shape of x and y.
        """
        s = self.S
        x_, y_ = real("x", x), real("y", y)
        b = s[0, 2] * x_ + s[1, 2] * y_ + s[2, 3]
        c = s[0, 0] * x_**2 + 2 * s[0, 1] * x_ * y_ + s[1, 1] * y_**2 + 2 * (s[0, 3] * x_ + s[1, 3] * y_) + s[3, 3]
        square = b * b - s[2, 2] * c
        root = np.sqrt(np.where(square >= 0.0, square, np.nan))
        # not (-b + root)/c33: that cancels, and divides by zero on a plane
        result: Floats = -c / (b + np.copysign(root, b))
        return result

    def project(self, point: ArrayLike) -> Floats:
        """The foot of a point (3,) on the surface: Newton on the Lagrange conditions from a point nearby.

        Raises:
            UsageError: when the point has no foot within reach (too far off, or at a centre of curvature).
        """
        p = checked("point", point, (3,))
        x, multiplier = p.copy(), 0.0
        for _ in range(30):
            g, f = self.gradient(x), float(self.value(x))
            if multiplier == 0.0:
                multiplier = f / max(float(g @ g), 1e-300)
            system = np.zeros((4, 4))
            system[:3, :3] = np.eye(3) + 2.0 * multiplier * self.S[:3, :3]
            system[:3, 3] = system[3, :3] = g
            try:
                step = np.linalg.solve(system, -np.append(x - p + multiplier * g, f))
            except np.linalg.LinAlgError:
                break
            x, multiplier = x + step[:3], multiplier + float(step[3])
            if np.abs(step[:3]).max() <= 1e-15 * (1.0 + np.abs(x).max()):
                return x
        if abs(float(self.value(x))) <= 1e-12 * float(np.linalg.norm(self.gradient(x))):
            return x
        raise UsageError(f"point: expected a point near the surface, got {p.tolist()} without a foot on it")

    def _gradient_size(self, point: ArrayLike) -> float:
        g = self.gradient(checked("point", point, (3,)))
        size = math.sqrt(float(g @ g))
        if not size > 0.0:
            raise UsageError(f"point: expected one where the surface has a normal, got {np.asarray(point).tolist()}")
        return size


def _places(points: ArrayLike) -> Floats:
    """Points (…, 3) as floats."""
    p = real("points", points, " of shape (…, 3)")
    if p.shape[-1:] != (3,):
        raise UsageError(f"points: expected shape (…, 3), got {p.shape}")
    return p


def _nonzero(name: str, value: float) -> float:
    number = float(checked(name, value, ()))
    if number == 0.0:
        raise UsageError(f"{name}: expected a length other than 0, got 0")
    return number
