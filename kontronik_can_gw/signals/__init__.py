"""Bits of a CAN message: packing, unpacking, units, end-to-end protection. No I/O, no clock."""
