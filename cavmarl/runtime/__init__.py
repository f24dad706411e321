"""The worlds that run: the tick, its executor, and the first compilation."""
