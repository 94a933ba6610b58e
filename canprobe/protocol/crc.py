"""The three CRCs of CAN, bit by bit over integers, and byte by byte where speed counts.

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

    def byte_table(self) -> tuple[int, ...]:
        """What eight bits do to the register: next = (register << 8 ^ table[register >> (width − 8) ^ byte]) & mask."""
        return tuple(self.add(0, byte, 8) for byte in range(256))


CRC15 = Crc(15, 0x4599)
CRC17 = Crc(17, 0x1685B, 1 << 16)
CRC21 = Crc(21, 0x102899, 1 << 20)
