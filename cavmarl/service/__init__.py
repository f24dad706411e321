"""The coordination service: nodes, sessions, selection, access and events, over HTTP.

`server` starts it and `node_host` a node that runs worlds for it; both need the extra `service`.
"""
