"""Training: configuration, data, loss, optimiser, loop, checkpoints."""
