"""Everything that blocks, reads a clock or opens a port: around the pure core, and nowhere else when live."""
