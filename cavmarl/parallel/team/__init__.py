"""Worker processes that run the phases of one world together."""
