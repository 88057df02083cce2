"""The core: from bytes of ESCs to frames of messages and slots, and what an output is."""
