"""The three CRCs of CAN: bit by bit over integers, and tables for whole bytes where speed counts.

Source: ISO 11898-1:2015, CRC sequence: generators of CRC-15 (classical), CRC-17 (FD, up to 16 bytes) and CRC-21 (FD,
more than 16 bytes). The FD registers start with their highest bit set; before 2015 (Bosch CAN FD 1.0) they began at 0.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Crc:
    """One CRC: bits enter most significant first, nothing is reflected, nothing is added at the end.

    Attributes:
        width: bits of the register.
        polynomial: generator without its highest power.
        start: of the register.
    """

    width: int
    polynomial: int
    start: int = 0

    def of(self, value: int, n_bits: int) -> int:
        """CRC of the lowest `n_bits` of `value`, highest first."""
        return self.add(self.start, value, n_bits)

    def add(self, register: int, value: int, n_bits: int) -> int:
        """The register after `n_bits` more."""
        top, mask = self.width - 1, (1 << self.width) - 1
        for place in range(n_bits - 1, -1, -1):
            feedback = (register >> top ^ value >> place) & 1
            register = register << 1 & mask
            if feedback:
                register ^= self.polynomial
        return register

    def byte_tables(self, places: int) -> tuple[tuple[int, ...], ...]:
        """What each byte does to the register, when `places` − 1, …, 1, 0 bytes follow it: the CRC is linear."""
        mask, shift = (1 << self.width) - 1, self.width - 8
        last = tuple(self.add(0, byte, 8) for byte in range(256))
        found = [last]
        for _ in range(places - 1):
            found.append(tuple((register << 8 & mask) ^ last[register >> shift] for register in found[-1]))
        return tuple(reversed(found))


CRC15 = Crc(15, 0x4599)
CRC17 = Crc(17, 0x1685B, 1 << 16)
CRC21 = Crc(21, 0x102899, 1 << 20)
