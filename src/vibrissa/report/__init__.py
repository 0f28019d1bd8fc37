"""A trial or a map as one web page that opens offline: what was done, how well, pictures, origin.

Sections are made by pure functions of datasets; figures are drawn elsewhere and handed in. The page
loads nothing: pictures, movies and scripts are in the file, and its security policy forbids more.
"""

from vibrissa.report.contact_map import chart_sections
from vibrissa.report.page import Section, document, figure_sections, movies_section, table
from vibrissa.report.provenance import Provenance, provenance, provenance_section
from vibrissa.report.space import (
    NO_SPACE,
    can_draw,
    contacts_in_space,
    reachable_space,
    space_section,
)
from vibrissa.report.trial import contacts_by_whisker, trial_sections

__all__ = [
    "NO_SPACE",
    "Provenance",
    "Section",
    "can_draw",
    "chart_sections",
    "contacts_by_whisker",
    "contacts_in_space",
    "document",
    "figure_sections",
    "movies_section",
    "provenance",
    "provenance_section",
    "reachable_space",
    "space_section",
    "table",
    "trial_sections",
]
