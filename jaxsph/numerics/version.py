"""The version, where all can import it from."""

__version__ = "0.2.0"
