"""GCNet, LCNet and PS-FCN, re-implemented."""
