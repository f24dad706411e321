"""The web viewer: a page that shows a running world, and the server that feeds it.

See docs/guides/viewer.md.
"""
