"""Transfer functions as tables that are looked up: values, means over ranges, slopes."""
