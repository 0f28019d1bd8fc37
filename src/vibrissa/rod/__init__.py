"""How a whisker bends: the rod, its loads, and the stable contacts it can hold.

Beyond loads and :func:`deflect` this is what the inverse problem is built on: the rod's kernels,
the chart of the stable contacts, and the search for contacts of given signals in it.
"""

from vibrissa.rod.chart import (
    CELLS,
    LEAST_ARC,
    PROXIMAL,
    Fold,
    StableSet,
    along,
    chart_of,
    chart_to_contact,
    contacts_at,
    determinant,
    fold_force,
    fold_forces,
    stable_set,
    with_normal_force,
)
from vibrissa.rod.deflection import Deflection, Load, PegContact, PointContact, PointForce
from vibrissa.rod.discretization import STEPS, Discretization, Rod, discretize
from vibrissa.rod.gravity import Resting, Weighted, evaluated, resting
from vibrissa.rod.integration import contact_tangents, evaluate, integrate, solve_forces
from vibrissa.rod.kernels import (
    BUFFER_SIZE,
    LANES,
    contact_state,
    lane_tangents,
    lane_value,
    lanes_tangents,
    set_all_lanes,
    set_lane,
)
from vibrissa.rod.newton import (
    ROUNDING,
    TOLERANCE,
    newton_group,
    point_determinant,
    stable,
    start_from,
)
from vibrissa.rod.outward import contact_forces, shapes, vanishing_moments
from vibrissa.rod.points import PointSolver, point_solver
from vibrissa.rod.search import MOST_CELLS, MOST_SEEDS, cells_around, seeds
from vibrissa.rod.statics import deflect
from vibrissa.rod.surfaces import SurfaceDeflection, follow_surfaces
from vibrissa.rod.tree import PlaneVector, SearchTree, search_tree

__all__ = [
    "BUFFER_SIZE",
    "CELLS",
    "LANES",
    "LEAST_ARC",
    "MOST_CELLS",
    "MOST_SEEDS",
    "PROXIMAL",
    "ROUNDING",
    "STEPS",
    "TOLERANCE",
    "Deflection",
    "Discretization",
    "Fold",
    "Load",
    "PegContact",
    "PlaneVector",
    "PointContact",
    "PointForce",
    "PointSolver",
    "Resting",
    "Rod",
    "SearchTree",
    "StableSet",
    "SurfaceDeflection",
    "Weighted",
    "along",
    "cells_around",
    "chart_of",
    "chart_to_contact",
    "contact_forces",
    "contact_state",
    "contact_tangents",
    "contacts_at",
    "deflect",
    "determinant",
    "discretize",
    "evaluate",
    "evaluated",
    "fold_force",
    "fold_forces",
    "follow_surfaces",
    "integrate",
    "lane_tangents",
    "lane_value",
    "lanes_tangents",
    "newton_group",
    "point_determinant",
    "point_solver",
    "resting",
    "search_tree",
    "seeds",
    "set_all_lanes",
    "set_lane",
    "shapes",
    "solve_forces",
    "stable",
    "stable_set",
    "start_from",
    "vanishing_moments",
    "with_normal_force",
]
