"""Benchmarks: one question a script, asked on the machine it runs on.

Run one as ``python -m benchmarks.throughput`` or ``python benchmarks/throughput.py``, all of them
as ``python -m benchmarks``. Each checks its answers against a plain NumPy filter before it takes a
time, prints a table and, with ``--json PATH``, writes what it measured.
"""
