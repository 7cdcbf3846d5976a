"""How good a trained model is, in numbers and in pictures."""

from sharpfield.evaluation.evaluate import METRICS, Measuring, evaluate
from sharpfield.evaluation.paths import CameraPath, camera_path
from sharpfield.evaluation.refine import Refined, Refinement, aligned_poses, refine_poses
from sharpfield.evaluation.report import REPORT, Story, write_report
from sharpfield.evaluation.tables import Table, markdown, methods_table, views_table
from sharpfield.evaluation.validation import validation
from sharpfield.evaluation.video import film, write_film

__all__ = [
    "METRICS",
    "REPORT",
    "CameraPath",
    "Measuring",
    "Refined",
    "Refinement",
    "Story",
    "Table",
    "aligned_poses",
    "camera_path",
    "evaluate",
    "film",
    "markdown",
    "methods_table",
    "refine_poses",
    "validation",
    "views_table",
    "write_film",
    "write_report",
]
