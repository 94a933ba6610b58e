"""An array's image model, and contacts of its pad whose images are those of the model."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from canprobe.mechanics.touch import ContactSample, ImageModel
from canprobe.mechanics.touch.image.calibration import ImageParameters, MomentErrors
from canprobe.mechanics.touch.image.image_model import USUAL_LIGHTNESS
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation

RADIUS, STIFFNESS, PITCH, COUNT_PA = 0.040, 1.27e8, 1.5875e-3, 100e3 / 255
LEVEL_PA = 6 * COUNT_PA
FORCE = 2.0
PARAMETERS = ImageParameters(stiffness=STIFFNESS, scale=1.05, blur=1.15e-3, crosstalk=0.02, memory=0.03)
ERRORS = MomentErrors(moment=2.0e-4, both=0.7e-4, shear=0.45e-4, frame_sigma=0.002)
FLOOR = ((ERRORS.moment, ERRORS.both, 0.0), (ERRORS.both, ERRORS.moment, 0.0), (0.0, 0.0, ERRORS.shear))
HERE_T = (
    LEVEL_PA / 1.05 / STIFFNESS / math.sqrt(2.0 * FORCE * 0.5 * math.sqrt((25.0 + 27.8) * 25.0) / math.pi / STIFFNESS)
)
"""Level over peak pressure at 2 N on a cylinder of 36 mm."""
HERE_FLOOR = HERE_T / USUAL_LIGHTNESS * np.array(FLOOR)
"""Covariance of the moments' errors there, along both axes and of the shear."""


def model(parameters=PARAMETERS, level=LEVEL_PA, seen=16):
    found = ImageModel(parameters, ERRORS, Pad(pitch_m=PITCH, mount_radius_m=RADIUS), seen)
    found.level = level
    return found


def entries(K):
    return K[0, 0], K[0, 1], K[1, 1]


def tensor(k1, k2, angle):
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s], [s, c]])
    return R @ np.diag([k1, k2]) @ R.T


def samples(K_base, normal, force, moments_of, n, *, spin=0.0, off_pole=(0.0, 0.0)):
    """n touches of a resting contact whose images have the moments of the model, in the pad's own axes.

    The pad's axes at the contact are the probe's x and y turned there by the shortest rotation from the pole.
    """
    d = np.array([*off_pole, math.sqrt(1.0 - np.dot(off_pole, off_pole))])
    axis = np.cross([0.0, 0.0, 1.0], d)
    sine = np.linalg.norm(axis)
    to_contact = Rotation.from_rotvec(axis / sine * math.asin(sine)) if sine > 0 else Rotation.identity()
    # any probe attitude that brings d onto the inward normal, spun about it
    reach = Rotation.align_vectors([-normal], [d])[0]
    R = (Rotation.from_rotvec(-normal * spin) * reach).as_matrix()
    e = R @ to_contact.as_matrix()[:, :2]
    k = e.T @ K_base @ e
    T = homogeneous(R, -(RADIUS - 0.4e-3) * R @ d)
    return [
        ContactSample(i * 5e-3, np.zeros(3), normal, T, (RADIUS - 0.4e-3) * d, force, moments=moments_of(entries(k)))
        for i in range(n)
    ]


def exact(k):
    return model().moments(k, FORCE)


NORMAL = np.array([0.3, -0.5, 0.8]) / math.sqrt(0.98)


def base_tensor(K, normal=NORMAL):
    B = tangent_rotation(-normal)[:, :2]
    return B @ K @ B.T
