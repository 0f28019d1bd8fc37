"""Scores against the truth: one for each stage, used by the demo, reports and studies alike."""

from vibrissa.evaluation.contacts import (
    ANGLES,
    REPLICATES,
    ErrorRow,
    Scores,
    angle_label,
    contact_errors,
    deflection_angle,
    error_rows,
    score,
)
from vibrissa.evaluation.stages import (
    SignalRow,
    TrackingScores,
    signal_errors,
    spread,
    tracking_scores,
)
from vibrissa.evaluation.truth import caution, truth_of, with_truth

__all__ = [
    "ANGLES",
    "REPLICATES",
    "ErrorRow",
    "Scores",
    "SignalRow",
    "TrackingScores",
    "angle_label",
    "caution",
    "contact_errors",
    "deflection_angle",
    "error_rows",
    "score",
    "signal_errors",
    "spread",
    "tracking_scores",
    "truth_of",
    "with_truth",
]
