"""An MPM-style method: our reconstruction."""
