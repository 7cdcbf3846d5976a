"""Faster versions of ops, one file per file of `ops/`; the parity test holds them to the reference.

Importing a file registers its versions; `ops/_dispatch.py` does that on the first call of an op.
"""
