"""The commands: each parses, and hands over."""
