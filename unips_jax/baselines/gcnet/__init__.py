"""GCNet, LCNet and PS-FCN, re-implemented: begin in `pipeline`."""
