"""The core: from bytes of ESCs to frames of messages and slots, and what an output is.

* ``interface``, ``settings``, ``python_core``: calls and settings of a core, and the core in Python
* ``esc_stream``: telemetry of one ESC, from its bytes and from time
* ``messages``, ``slots``: pending messages of the DBC and frames of the outputs
* ``output``, ``output_setup``: calls of an output, and its settings before it is made
* ``header_parts``: checked parts of a capture's header
"""
