"""Captures on disk: layouts of data sets, our own layout, trajectories, writers and summaries."""
