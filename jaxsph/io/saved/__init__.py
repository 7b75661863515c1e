"""What users save and read again: camera paths and transfer functions, as JSON."""
