"""KONTRONIK telemetry on the wire: fields, states, codec, deframer. No I/O, no clock."""
