"""The state of worlds as bytes, images and logs, from which another process can resume."""
