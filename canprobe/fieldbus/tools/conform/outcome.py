"""The ways in which a point of the examination may end without a pass."""

from __future__ import annotations

from canprobe.errors import CanprobeError


class Deviation(CanprobeError):  # noqa: N818 - a verdict, as the others here
    """The device does not do what the clause says: the point fails."""


class PointNotApplicable(CanprobeError):  # noqa: N818
    """The point cannot be examined on this device or on this bus; the message says why."""


class NotPermitted(PointNotApplicable):
    """The bench would have to send what it must not send here; nothing was sent."""


class BenchFailure(CanprobeError):  # noqa: N818
    """The bench failed, not the device: the verdict is ERROR."""


class PowerStageOn(BenchFailure):
    """The power stage of a drive is on although no point switched it on: the examination ends."""
