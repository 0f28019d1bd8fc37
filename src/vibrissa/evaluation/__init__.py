"""Scores against the truth: one for each stage, used by the demo, reports and studies alike."""

from vibrissa.evaluation.contacts import (
    ANGLES as ANGLES,
    REPLICATES as REPLICATES,
    ErrorRow as ErrorRow,
    Scores,
    angle_label as angle_label,
    contact_errors,
    deflection_angle,
    error_rows as error_rows,
    score as score,
)
from vibrissa.evaluation.stages import (
    SignalRow as SignalRow,
    TrackingScores,
    caution as caution,
    signal_errors,
    spread,
    tracking_scores,
    truth_of,
    with_truth as with_truth,
)

__all__ = [
    "Scores",
    "TrackingScores",
    "contact_errors",
    "deflection_angle",
    "signal_errors",
    "spread",
    "tracking_scores",
    "truth_of",
]
