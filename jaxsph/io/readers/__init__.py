"""Readers of particle files, one a format; what is damaged is refused by one `ValueError` that names the file (`damage`)."""
