"""Ownership of vehicles: the protocol that moves it from zone to zone.

See docs/explanation/ownership.md. Pure: the standard library, no input or output, no clock, no
threads, no chance. `Directory` is the coordinator's side and `Endpoint` that of a zone host; both
take messages and answer with what to do. `runtime/` puts stores, journals and processes around
them.
"""
