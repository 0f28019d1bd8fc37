"""Report of a trial or a map as one self-contained web page.

The page contains results, errors, figures and provenance. Sections are computed by pure functions
of datasets; figures are drawn elsewhere and passed in. Pictures, movies and scripts are embedded in
the file, and its security policy forbids loading anything else.
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

__all__ = ["document", "in_space", "reachable_space"]
__dir__ = __all__.copy
