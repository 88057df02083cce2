"""CAN frames described by a DBC: the DBC in use is the layout."""
