"""Lost messages and dying hosts by plan, and recovery from the committed state."""
