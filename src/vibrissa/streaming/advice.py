"""Advice on a stream as a whole."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vibrissa.streaming.contacts import ContactStream

# Share of samples above which something is wrong in general.
_NEARLY_ALL = 0.9


def advice(stream: ContactStream) -> list[str]:
    """Suspect what users get wrong most often."""
    counts, total = stream.statuses, stream.samples
    measured = total - counts["missing"] - counts["tare"]
    touching = measured - counts["not_felt"]
    unexplained = counts["outside_map"] + counts["not_frictionless"]
    out = []
    if touching > 0 and unexplained > _NEARLY_ALL * touching:
        larger = (
            "are larger than any that this whisker can give"
            if counts["outside_map"] > unexplained / 2
            else "are of no contact that this whisker can have"
        )
        out.append(
            f"Nearly all signals {larger}: are they in N and N·m (or does the sensor's mixing say "
            "what they are in), is the offset taken away, are the sensor's axes, sign and weight "
            "and the base's rotation right, and the whisker's stiffness?"
        )
    if measured > 0 and not touching:
        out.append(
            "No signal was far enough from zero for a contact: are the signals in N and N·m, and "
            "is the stated noise right?"
        )
    if total and counts["missing"] == total:
        out.append(
            "All samples are missing something: a number, the pose at that time, or readings are "
            "as large as the largest that the sensor can say."
        )
    if stream.slow > _NEARLY_ALL * max(total - 1, 1):
        out.append("Samples lie minutes apart: is their time in s?")
    if stream.poses.too_fast > 0.5 * stream.poses.number > 0:
        out.append("The base moves at more than 50 m/s: is its position in m, its time in s?")
    return out
