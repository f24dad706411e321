"""Workers on other machines: processes that somebody else starts, and frames over sockets."""
