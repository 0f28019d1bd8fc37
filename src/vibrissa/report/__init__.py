"""A trial or a map as one web page that opens offline: what was done, how well, pictures, origin.

Sections are made by pure functions of datasets; figures are drawn elsewhere and handed in. The page
loads nothing: pictures, movies and scripts are in the file, and its security policy forbids more.
"""

from vibrissa.report.page import (
    Section as Section,
    document,
    figure_sections as figure_sections,
    movies_section as movies_section,
    provenance_section as provenance_section,
    table as table,
)
from vibrissa.report.sections import (
    chart_sections as chart_sections,
    contacts_by_whisker as contacts_by_whisker,
    trial_sections as trial_sections,
)
from vibrissa.report.space import (
    NO_SPACE as NO_SPACE,
    can_draw as can_draw,
    in_space,
    reachable_space,
    space_section as space_section,
    trial_in_space as trial_in_space,
)

__all__ = [
    "document",
    "in_space",
    "reachable_space",
]
