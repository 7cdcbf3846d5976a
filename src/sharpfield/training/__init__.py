"""Training a model: the loop, its optimizer, hooks, checkpoints, logs and memory plan.

Any `Model` can be trained; no recipe is imported here. `session.train` is a whole run in a folder,
`loop.fit` the loop alone.
"""
