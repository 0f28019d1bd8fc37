"""A trial or a map as one web page that opens offline: what was done, how well, pictures, origin.

Sections are made by pure functions of datasets; figures are drawn elsewhere and handed in. The page
loads nothing: pictures, movies and scripts are in the file, and its security policy forbids more.
"""

from vibrissa.report.chart import chart_sections
from vibrissa.report.media import figure_sections, movies_section
from vibrissa.report.page import Section, document, table
from vibrissa.report.provenance import Provenance, provenance, provenance_section
from vibrissa.report.space import contacts_in_space, reachable_space, space_section
from vibrissa.report.tracked import contacts_by_whisker
from vibrissa.report.trial import trial_sections

__all__ = [
    "Provenance",
    "Section",
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
