"""The coordination service: nodes, sessions, node selection, access control and events over HTTP.

`server` starts the service. `node_host` starts a node that runs worlds for it. Both need the extra
`service`.
"""
