"""All code of the live gateway that blocks, reads a clock or opens a port.

* ``loop``, ``poller``, ``native_poller``, ``housekeeping``: the loop, and its work once a second
* ``port_input``, ``retry``: notes about reading a port, pauses between attempts
* ``ports/``: one ESC's port: open, read, find again
* ``can/``: the CAN interface: open, send, receive, state of the controller, advice
* ``files/``: captures and CANopen parameters on disk
* ``status/``: the status document and its file
* ``system/``: log, service manager, locks, folders, threads, the wall clock, facts of the machine
"""
