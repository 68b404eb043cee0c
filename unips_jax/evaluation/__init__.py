"""Benchmarks, the resumable runner, sheets and reports."""
