"""Compiled loops: sending, channel, receiving, and inboxes."""
