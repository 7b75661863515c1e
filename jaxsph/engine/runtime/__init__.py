"""What programs are run by: compiled programs, executors, devices, memory, tuning."""
