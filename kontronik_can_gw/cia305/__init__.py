"""Layer setting services (LSS) by CiA 305: the slave."""
