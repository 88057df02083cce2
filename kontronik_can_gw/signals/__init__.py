"""Bits of a CAN message: packing, unpacking, units, end-to-end protection. Pure."""
