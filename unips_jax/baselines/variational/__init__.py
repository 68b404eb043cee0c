"""Variational uncalibrated photometric stereo, re-implemented."""
