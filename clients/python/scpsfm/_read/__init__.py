"""Readers of the files that tracks come in."""
