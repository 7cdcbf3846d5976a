"""Columns of events on disk: what captures and recordings both read and write."""
