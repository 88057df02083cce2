"""ESCs: the seam of a protocol, the state of one ESC, published values. One folder a protocol."""
