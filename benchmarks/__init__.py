"""Benchmarks: every one prints a table and writes ``{"metrics": {name: number}}`` with ``--json``."""
