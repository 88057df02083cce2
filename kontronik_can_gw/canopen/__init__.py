"""The CANopen node (CiA 301): one module for each service.

There is no I/O. Times are arguments, in whole nanoseconds.

* ``setup``, ``node_settings``: from a configuration or a capture to nodes
* ``nodes``, ``node``, ``cob_ids``: all nodes, one node, routing of frames
* ``dictionary``, ``eds``, ``eds_changes``, ``check``: object dictionary, EDS files
* ``objects``, ``bound_values``, ``esc_objects``: objects that show values of an ESC
* ``sdo``, ``sdo_transfers``, ``pdo``, ``nmt``, ``emergency``, ``lss``, ``storage``: one
  service each
* ``dbc``, ``dbc_signals``, ``dbc_names``: PDOs, heartbeats and emergencies as a DBC
"""
