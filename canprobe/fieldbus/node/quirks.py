"""What makes an emulated node difficult, on request."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Quirks:
    """What makes an emulated drive difficult, to rehearse one that is.

    Attributes:
        refuse: indices of objects that refuse every write with 06010000h.
        boot_ns: from reset to the boot-up message.
        sdo_ns: from an SDO request to its answer.
        fixed_mapping: mappings and COB-IDs of PDOs are read-only, whatever the EDS states.
        tpdo_delay_ns: from SYNC to the TPDOs that it triggers.
        noise_counts: standard deviation of the encoder, counts.
        keep_bit30: a COB-ID of a TPDO that is written must have bit 30 (no RTR) as it is, else 06090030h.
        brake_early_ns: from the brake's opening to torque in the motor; a vertical axis of a dynamic arm falls.
    """

    refuse: tuple[int, ...] = ()
    boot_ns: int = 0
    sdo_ns: int = 0
    fixed_mapping: bool = False
    tpdo_delay_ns: int = 0
    noise_counts: float = 0.0
    keep_bit30: bool = False
    brake_early_ns: int = 0
