"""Tests a CANopen slave on a bus as a black box against CiA 301, CiA 305 and CiA 306."""
