"""What survives a worker: checkpoints of worlds and logs of actions since."""
