"""What the training programs share: their options, PPO on batched worlds, runs and checkpoints."""
