"""Numerical kernels as pure functions: one file per operation, plain torch or numpy first.

A file is a namespace, as in `from sharpfield.ops import composite, stepfun`, so that a call reads
`composite.weigh(...)`, `stepfun.merge(...)`. Faster versions live in `ops/fast/`.
"""
