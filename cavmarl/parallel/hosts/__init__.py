"""Workers on other machines: frames over sockets, and Ray's actors that run them."""
