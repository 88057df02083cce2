"""What every ESC has: its state, the values it supplies, a simulated one; the protocols it speaks in folders of their own."""
