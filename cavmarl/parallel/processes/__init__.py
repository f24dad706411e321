"""Worker processes of this machine: forked, watched, replaced, with memory that they share."""
