"""Transfer functions: from values to colours and extinction."""
