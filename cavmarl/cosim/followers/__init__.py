"""External stacks that follow a world's clock: a socket, its messages, and both ends."""
