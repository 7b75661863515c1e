"""Dumps of Phantom: its own format, and those converted to HDF5; what either means is in `dumps`."""
