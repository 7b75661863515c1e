"""The version, where all can import it from."""

__version__ = "0.1.0"
