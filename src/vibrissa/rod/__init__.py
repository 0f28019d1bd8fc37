"""How a whisker bends: the rod, its loads, and the stable contacts it can hold.

Beyond loads and :func:`deflect` this is what the inverse problem is built on: the rod's kernels,
the chart of the stable contacts, and the search for contacts of given signals in it.
"""

from vibrissa.rod.around import (
    NearObjects as NearObjects,
    ObstacleDeflection,
    around as around,
    deflect_around,
)
from vibrissa.rod.chart import (
    CELLS as CELLS,
    LEAST_ARC as LEAST_ARC,
    PROXIMAL,
    Charted as Charted,
    Fold as Fold,
    StableSet as StableSet,
    along as along,
    chart_of as chart_of,
    chart_to_contact as chart_to_contact,
    charted_rod as charted_rod,
    contacts_at as contacts_at,
    determinant as determinant,
    fold_force as fold_force,
    fold_forces as fold_forces,
    interpolant as interpolant,
    interpolate as interpolate,
    stable_set as stable_set,
    with_normal_force as with_normal_force,
)
from vibrissa.rod.deflection import Deflection, Load, PegContact, PointContact, PointForce
from vibrissa.rod.discretization import (
    STEPS,
    Discretization,
    Rod as Rod,
    Weight as Weight,
    check_whisker as check_whisker,
    discretize,
)
from vibrissa.rod.gravity import (
    Resting,
    Weighted as Weighted,
    evaluated as evaluated,
    near_direction as near_direction,
    resting,
)
from vibrissa.rod.integration import (
    contact_tangents as contact_tangents,
    evaluate as evaluate,
    integrate as integrate,
    solve_forces,
)
from vibrissa.rod.kernels import (
    BUFFER_SIZE as BUFFER_SIZE,
    LANES as LANES,
    contact_state as contact_state,
    lane_slopes as lane_slopes,
    lane_tangents as lane_tangents,
    lane_value as lane_value,
    lanes_tangents as lanes_tangents,
    set_all_lanes as set_all_lanes,
    set_lane as set_lane,
)
from vibrissa.rod.newton import (
    ROUNDING as ROUNDING,
    TOLERANCE as TOLERANCE,
    Group as Group,
    group_room as group_room,
    newton_group as newton_group,
    point_determinant as point_determinant,
    stable as stable,
    start_from as start_from,
)
from vibrissa.rod.obstacles import Equilibrium as Equilibrium
from vibrissa.rod.outward import (
    contact_forces as contact_forces,
    shapes as shapes,
    vanishing_moments as vanishing_moments,
)
from vibrissa.rod.points import PointSolver as PointSolver, point_solver as point_solver
from vibrissa.rod.search import (
    MOST_CELLS as MOST_CELLS,
    MOST_SEEDS as MOST_SEEDS,
    cells_around as cells_around,
    compile_seeds as compile_seeds,
    seed_room as seed_room,
    seeds as seeds,
)
from vibrissa.rod.statics import check_objects as check_objects, deflect
from vibrissa.rod.surfaces import (
    SurfaceDeflection as SurfaceDeflection,
    follow_surfaces as follow_surfaces,
)
from vibrissa.rod.tree import (
    Balance as Balance,
    PlaneVector as PlaneVector,
    SearchTree as SearchTree,
    balance_rows as balance_rows,
    balanced as balanced,
    search_tree as search_tree,
)
from vibrissa.rod.weight import evaluate_weighted as evaluate_weighted

__all__ = [
    "PROXIMAL",
    "STEPS",
    "Deflection",
    "Discretization",
    "Load",
    "ObstacleDeflection",
    "PegContact",
    "PointContact",
    "PointForce",
    "Resting",
    "deflect",
    "deflect_around",
    "discretize",
    "resting",
    "solve_forces",
]
__dir__ = __all__.copy
