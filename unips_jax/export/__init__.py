"""The network as files that other programs load; see docs/export.md."""
