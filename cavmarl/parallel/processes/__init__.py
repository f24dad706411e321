"""Worker processes of this machine: how they are forked, commanded, watched and replaced."""
