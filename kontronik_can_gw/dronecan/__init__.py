"""DroneCAN nodes that report the ESCs to an autopilot (specification 1.0 on classic CAN)."""
