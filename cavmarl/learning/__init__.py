"""Shared parts of the training programs: options, the network, logs, runs and checkpoints."""
