"""The sensing of one world in processes of its own."""
