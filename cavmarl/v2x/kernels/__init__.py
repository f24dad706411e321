"""Compiled loops: sending, the channel, receiving, inboxes."""
