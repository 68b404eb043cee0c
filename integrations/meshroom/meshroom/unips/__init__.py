"""Meshroom nodes."""

CHECKED_AGAINST = "2026.1.0"  # Meshroom's version; see UniPSNormals

__version__ = "1.0"
