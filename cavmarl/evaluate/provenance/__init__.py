"""Provenance of results: hardware, versions, hashes, training runs."""
