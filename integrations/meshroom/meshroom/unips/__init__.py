"""Meshroom nodes."""

__version__ = "1.0"
