"""Which worker or node runs what, how that changes, and the commands that go there."""
