"""The UniPS network as Flax Linen modules."""
