"""Benchmarks: each prints a table, and writes ``{"metrics": {name: number}}`` with ``--json``."""
