"""Files that a running gateway keeps: captures and CANopen parameters."""
