"""The web viewer: a page that shows a running world, and its server.

See docs/guides/viewer.md.
"""
