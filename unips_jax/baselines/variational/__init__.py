"""Variational uncalibrated photometric stereo, re-implemented: begin in `pipeline`."""
