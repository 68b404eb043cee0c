"""An MPM-style method, our reconstruction: begin in `pipeline`."""
