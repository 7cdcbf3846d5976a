"""How good a trained model is, in numbers and in pictures."""

from sharpfield.evaluation.evaluate import METRICS, Measuring, evaluate

__all__ = ["METRICS", "Measuring", "evaluate"]
