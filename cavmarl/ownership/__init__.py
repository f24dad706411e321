"""The protocol that moves the ownership of vehicles from zone to zone.

See docs/explanation/ownership.md. The package is pure: it uses only the standard library, without
input or output, clocks, threads or random numbers. `Directory` is the coordinator's side, and
`Endpoint` is the side of a zone host. Both classes receive messages and return actions. `handoff`
and `parallel` provide stores, journals and processes.
"""
