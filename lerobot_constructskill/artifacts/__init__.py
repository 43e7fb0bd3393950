"""Specification, digest, folder: hashes, locks, whole-or-nothing writing, worker pools. Knows nothing of robots."""
