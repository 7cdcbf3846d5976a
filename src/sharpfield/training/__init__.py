"""Training a model: the loop, its optimizer, hooks, checkpoints, logs and memory plan.

Knows `Model`, knows no recipe. `train` is a whole run in a folder; `fit` is the loop alone.
"""
