"""How good a trained model is, in numbers and in pictures."""

from sharpfield.evaluation.evaluate import METRICS, Measuring, evaluate
from sharpfield.evaluation.report import REPORT, Story, write_report
from sharpfield.evaluation.tables import Table, markdown, methods_table, views_table

__all__ = [
    "METRICS",
    "REPORT",
    "Measuring",
    "Story",
    "Table",
    "evaluate",
    "markdown",
    "methods_table",
    "views_table",
    "write_report",
]
