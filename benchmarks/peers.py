# ruff: noqa: T201 -- a script that reports
"""Static equilibrium of a tapered rod under a point force, by vibrissa and by other programs.

    pip install pyelastica mujoco soromox
    python benchmarks/peers.py [--elements 10 20]

A straight rod (40 mm, 0.4 mm in radius at the base, ratio 15) is bent by a force at 0.6 of its
length until the tangent there has turned by about 65°. Beyond the force nothing is loaded, so that
all three solve the rod up to it. vibrissa has the force in the bent frame and integrates once, or
has the point and searches; SciPy's ``solve_bvp`` and PyElastica have the force in space.
PyElastica, which is dynamic, is damped until the loaded point moves by less than 1e-6 of the length
in a period of its slowest vibration. MuJoCo has a chain of bodies with springs in their hinges,
damped until the end moves by less than 1e-7 of the length in 50 steps; SoRoMox pieces of constant
curvature, whose springs and Jacobian are in balance with the force after a few steps of Newton's
method with the derivatives of JAX. Errors are distances of the loaded point over the length, from
vibrissa with eight times the steps, which ``solve_bvp`` at 1e-10 confirms; PyElastica's rod also
stretches and shears, which alone is some 1e-4. Times are CPU times of one core, after a first call
that compiles. Programs that are not installed are left out.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.integrate import solve_bvp

import vibrissa as vb

WHERE = 0.6
Row = tuple[str, np.ndarray, float]
"""Name, loaded point (x, y), m, and CPU time, s."""


def timed(work: Callable[[], Any], rounds: int) -> tuple[Any, float]:
    taken = []
    for _ in range(rounds):
        begun = time.process_time()
        found = work()
        taken.append(time.process_time() - begun)
    return found, min(taken)


def of_vibrissa(whisker: vb.Whisker, load: vb.PointForce, n: int = 100_000) -> Iterator[Row]:
    bent, seconds = timed(lambda: vb.deflect(whisker, load), 50)
    yield "vibrissa, a force", bent.contact_point[:2], seconds
    many = load.rows(np.zeros(n, int))
    bent, seconds = timed(lambda: vb.deflect(whisker, many), 5)
    yield f"vibrissa, {n:,} forces, each", bent.contact_point[0, :2], seconds / n
    points = vb.PointContact(bent.contact_point)
    bent, seconds = timed(lambda: vb.deflect(whisker, points), 3)
    # Its error is that of the wrench: the point is prescribed.
    yield f"vibrissa, {n:,} points, each", bent.contact_point[0, :2], seconds / n


def of_scipy(whisker: vb.Whisker, force: np.ndarray, tolerance: float) -> Row:
    """(x, y, θ) from the base and M from the force, in units of the loaded length."""
    end = WHERE * whisker.length

    def stiffness(s: np.ndarray) -> np.ndarray:
        return whisker.youngs_modulus * np.pi / 4.0 * whisker.radius(s * end) ** 4 / end**2

    def slopes(s: np.ndarray, y: np.ndarray) -> np.ndarray:
        cos, sin = np.cos(y[2]), np.sin(y[2])
        return np.stack([cos, sin, y[3] / stiffness(s), force[0] * sin - force[1] * cos])

    def ends(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.array([a[0], a[1], a[2], b[3]])

    s = np.linspace(0.0, 1.0, 11)
    start = np.stack([s, 0.0 * s, 0.0 * s, 0.0 * s])

    def solve() -> Any:
        return solve_bvp(slopes, ends, s, start, tol=tolerance, max_nodes=100_000)

    found, seconds = timed(solve, 3)
    assert found.success
    return f"SciPy solve_bvp, tol {tolerance:.0e}", found.y[:2, -1] * end, seconds


def of_pyelastica(whisker: vb.Whisker, force: np.ndarray, elements: int) -> Row:
    import elastica as ea

    end, density = WHERE * whisker.length, 1000.0
    middles = (np.arange(elements) + 0.5) * end / elements
    radius = whisker.radius(middles)
    young = whisker.youngs_modulus
    speed, base = np.sqrt(young / density), whisker.base_radius
    period = 2.0 * np.pi / (3.5 * 0.5 * base * speed / end**2)
    step = 1.2 * min(radius.min(), end / elements) / speed

    class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping):
        pass

    simulator = Simulator()
    rod = ea.CosseratRod.straight_rod(
        elements,
        np.zeros(3),
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, 0.0, 1.0]),
        end,
        radius,
        density,
        youngs_modulus=young,
        shear_modulus=young / (2.0 * (1.0 + whisker.poisson_ratio)),
    )
    simulator.append(rod)
    simulator.constrain(rod).using(
        ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    simulator.add_forcing_to(rod).using(
        ea.EndpointForces, np.zeros(3), np.array([*force, 0.0]), ramp_up_time=step
    )
    # The slowest vibration is damped about critically.
    simulator.dampen(rod).using(
        ea.AnalyticalLinearDamper, uniform_damping_constant=4.0 * np.pi / period, time_step=step
    )
    simulator.finalize()
    stepper, now = ea.PositionVerlet(), np.float64(0.0)
    stepper.step(simulator, now, np.float64(step))  # compiles
    before, begun = np.full(3, np.inf), time.process_time()
    while np.linalg.norm(rod.position_collection[:, -1] - before) > 1e-6 * end:
        before = rod.position_collection[:, -1].copy()
        for _ in range(round(period / step)):
            now = stepper.step(simulator, now, np.float64(step))
    seconds = time.process_time() - begun
    name = f"PyElastica, {elements} elements, {now / step:,.0f} steps"
    return name, rod.position_collection[:2, -1], seconds


def of_mujoco(whisker: vb.Whisker, force: np.ndarray, elements: int) -> Row:
    """Lengths in units of the loaded one, forces in units of B/length², a body of mass h each."""
    import mujoco

    end, h = WHERE * whisker.length, 1.0 / elements
    bending = (
        whisker.youngs_modulus * np.pi / 4.0 * whisker.radius(np.arange(elements) * h * end) ** 4
    )
    springs = bending / bending[0] / h
    springs[0] *= 2.0  # the hinge at the clamp stands for half an element
    bodies = "".join(
        f'''<body pos="{h if i else 0.0} 0 0">
        <joint type="hinge" axis="0 0 1" stiffness="{spring}" damping="{0.3 * spring}"/>
        <inertial pos="{h / 2} 0 0" mass="{h}" diaginertia="{" ".join([str(h**3 / 12)] * 3)}"/>'''
        for i, spring in enumerate(springs)
    )
    point = '<inertial pos="0 0 0" mass="1e-4" diaginertia="1e-9 1e-9 1e-9"/></body>'
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option gravity="0 0 0" integrator="implicit" timestep="0.01"/><worldbody>'
        f'{bodies}<body name="end" pos="{h} 0 0">{point}{"</body>" * elements}</worldbody></mujoco>'
    )
    data, last = mujoco.MjData(model), model.body("end").id
    data.xfrc_applied[last, :2] = force * end**2 / bending[0]
    before, begun = np.full(3, np.inf), time.process_time()
    while np.linalg.norm(data.xpos[last] - before) > 1e-7:
        before = data.xpos[last].copy()
        mujoco.mj_step(model, data, 50)
    seconds = time.process_time() - begun
    return f"MuJoCo, {elements} bodies", data.xpos[last, :2] * end, seconds


def of_soromox(whisker: vb.Whisker, force: np.ndarray, elements: int) -> Row:
    import jax
    import jax.numpy as jnp
    from soromox.systems.components.links import LinkSpec
    from soromox.systems.pcs.planar_pcs import PlanarPCS, PlanarPCSStructure

    jax.config.update("jax_enable_x64", True)
    end = WHERE * whisker.length
    links = [
        LinkSpec.circular(
            length=end / elements,
            radius=float(whisker.radius((i + 0.5) * end / elements)),
            density=1000.0,
            reference_strain=[0.0, 1.0, 0.0],
            young_modulus=whisker.youngs_modulus,
            poisson_ratio=whisker.poisson_ratio,
        )
        for i in range(elements)
    ]
    bends = PlanarPCSStructure(strain_selector=[True, False, False] * elements)
    rod = PlanarPCS.from_links(links, structure=bends, base_pose=jnp.zeros(3))
    wrench = jnp.array([0.0, *force])

    def imbalance(q: Any) -> Any:
        return rod.K_active @ q - rod.jacobian_inertialframe(q, jnp.array(end)).T @ wrench

    @jax.jit
    def newton(q: Any) -> Any:
        return q - jnp.linalg.solve(jax.jacfwd(imbalance)(q), imbalance(q))

    def solve() -> Any:
        q, before = jnp.zeros(elements), jnp.full(elements, jnp.inf)
        while float(jnp.abs(q - before).max()) * end / elements > 1e-9:
            q, before = newton(q), q
        return q

    solve()  # compiles
    q, seconds = timed(solve, 3)
    place = np.asarray(rod.forward_kinematics(q, jnp.array(end)))[1:3]
    return f"SoRoMox, {elements} pieces", place, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--elements", type=int, nargs="*", default=[10, 20])
    options = parser.parse_args()
    whisker = vb.Whisker.straight(length=40e-3, base_radius=0.4e-3)
    load = vb.PointForce(WHERE * whisker.length, 80e-3, 0.0)
    exact = vb.deflect(whisker, load, steps=288)
    force, point = exact.force[:2], exact.contact_point[:2]
    turned = np.degrees(np.arctan2(-exact.force[0], exact.force[1]))
    print(f"Force {1e3 * np.linalg.norm(force):.0f} mN; the tangent turns by {turned:.0f}°.\n")
    print("| program | error over L | CPU of one |\n|---|---:|---:|")
    for name, found, seconds in rows(whisker, load, force, options.elements):
        error = np.linalg.norm(found - point) / whisker.length
        print(f"| {name} | {error:.1e} | {1e6 * seconds:,.3g} µs |", flush=True)


def rows(
    whisker: vb.Whisker, load: vb.PointForce, force: np.ndarray, elements: list[int]
) -> Iterator[Row]:
    yield from of_vibrissa(whisker, load)
    for tolerance in (1e-3, 1e-6, 1e-10):
        yield of_scipy(whisker, force, tolerance)
    for program, solver in PROGRAMS.items():
        try:
            for n in elements:
                yield solver(whisker, force, n)
        except ModuleNotFoundError:
            print(f"| {program} is not installed | | |")


PROGRAMS = {"PyElastica": of_pyelastica, "MuJoCo": of_mujoco, "SoRoMox": of_soromox}


if __name__ == "__main__":
    main()
