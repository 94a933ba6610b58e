"""Difficulties that an emulated node has on request."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Quirks:
    """Difficulties of an emulated drive, to rehearse those of a real one.

    Attributes:
        refuse: indices of objects that refuse every write with 06010000h.
        boot_ns: time from a reset to the boot-up message.
        sdo_ns: time from an SDO request to its answer.
        fixed_mapping: whether mappings and COB-IDs of PDOs are read-only, whatever the EDS states.
        tpdo_delay_ns: time from a SYNC to the TPDOs that it triggers.
        noise_counts: standard deviation of the encoder, counts.
        keep_bit30: whether a write to the COB-ID of a TPDO that changes bit 30 (no RTR) is refused with 06090030h.
        brake_early_ns: time from the opening of the brake to torque in the motor, in which a vertical axis of a dynamic
            arm falls.
    """

    refuse: tuple[int, ...] = ()
    boot_ns: int = 0
    sdo_ns: int = 0
    fixed_mapping: bool = False
    tpdo_delay_ns: int = 0
    noise_counts: float = 0.0
    keep_bit30: bool = False
    brake_early_ns: int = 0
