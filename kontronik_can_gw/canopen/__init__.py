"""The CANopen node (CiA 301): one module for each service.

There is no I/O. Times are arguments, in whole nanoseconds.
"""
