"""All code of the live gateway that blocks, reads a clock or opens a port."""
