"""KONTRONIK telemetry as it is on the wire: fields, states, codec, deframer. Standard library only, no I/O, no clock."""
