"""A robot's whisker: steel wire on a sensor with two channels, calibrated, in a moving base.

Aim: from a bare sensor to contact points on a robot. Data: simulated wires and rods of 300 mm, a
thousand times stiffer than a rat's whisker, and a sensor that reads two bending moments, mixed and
offset. Lesson: on a cylinder the axial force follows from the moment; loads determine
E r⁴ but not E; two signals leave a curve of contacts, of which the base's motion selects one.
"""

# %% Wires and rods: the same 300 mm, forces from millinewtons to tens of newtons
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import vibrissa as vb
from vibrissa import plots
from vibrissa.sensors import Sensor, calibrate_on_contacts, fit_stiffness

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "output")
folder.mkdir(parents=True, exist_ok=True)

STEEL = {"youngs_modulus": 200e9, "poisson_ratio": 0.29}
PLASTIC = {"youngs_modulus": 2e9, "poisson_ratio": 0.40}
rods = {
    "steel wire, cylinder": vb.Whisker.straight(
        0.3, base_radius=0.25e-3, tip_radius=0.25e-3, **STEEL
    ),
    "steel wire, tapered": vb.Whisker.straight(
        0.3, base_radius=0.5e-3, tip_radius=0.25e-3, **STEEL
    ),
    "plastic rod, tapered": vb.Whisker.straight(0.3, base_radius=4e-3, tip_radius=1e-3, **PLASTIC),
    "a rat's, for comparison": vb.samples.straight(),
}
maps = {name: vb.ContactMap.simulate(rod, grid=False) for name, rod in rods.items()}
for name, rod in rods.items():
    length = rod.length
    touch = vb.deflect(rod, vb.PointContact([0.7 * length, 0.07 * length, 0.0]))
    force, moment = np.linalg.norm(touch.force), np.linalg.norm(touch.moment)
    print(f"{name:24s} EI {rod.base_bending_stiffness:8.2g} N m²;", end=" ")
    print(f"pushed aside by 0.07 L at 0.7 L: {force:8.2g} N, {moment:8.2g} N m")

# %% Which three signals? Along a uniform straight rod m²/2EI + F·t does not change
# Both terms vanish at a frictionless contact, so F_x = -M_B²/2EI at the base: no third signal.
for name, contacts in maps.items():
    locating = [text for text in ("Fx MB MD", "FT MB MD") if contacts.determines(text)]
    print(f"{name:24s} contacts are determined by {' and by '.join(locating)}")

# %% The sensor: two channels, each a mix of both moments with an offset, which are unknown
wire, contacts = rods["steel wire, tapered"], maps["steel wire, tapered"]
true = Sensor(
    ("bridge a", "bridge b"),
    mixing=[[0, 0, 0, 0, 21.0, 1.5], [0, 0, 0, 0, -0.8, 19.0]],  # V / N m
    noise=2e-3,
    bias=[0.31, -0.12],
)

# Touch it at 40 known points and read; the rod gives the moments
rng = np.random.default_rng(1)
load = vb.PointForce(
    rng.uniform(0.12, 0.3, 40), rng.uniform(0.01, 0.06, 40), rng.uniform(-np.pi, np.pi, 40)
)
touched = vb.deflect(wire, load)
readings = true.read(np.arange(40.0), np.concatenate([touched.force, touched.moment], axis=1))
calibration = calibrate_on_contacts(
    wire,
    touched.contact_point,
    readings,
    channels=true.channels,
    components=("My", "Mz"),
)
sensor = calibration.sensor
gain = sensor.mixing[:, 4:]
deviation = np.sqrt(np.einsum("kii->ki", calibration.covariance))[:, :2]
print("mix, V / N m:", gain.round(3).tolist(), "±", deviation.round(3).tolist())
print("offset, V:", np.asarray(sensor.bias).round(4).tolist())
try:
    calibrate_on_contacts(wire, touched.contact_point, readings)
except ValueError as refusal:
    print("all six components at once:", refusal)

# %% Measuring the stiffness: a wire from a reel, 6 % softer than tabulated
soft = wire.with_properties(youngs_modulus=0.94 * wire.youngs_modulus)
bent = vb.deflect(soft, vb.PointContact(touched.contact_point))
weighed = Sensor(("Fy", "Fz"), noise=0.5e-3)  # by a scale, in newtons
found = fit_stiffness(
    wire,
    touched.contact_point,
    weighed.read(np.arange(40.0), np.concatenate([bent.force, bent.moment], axis=1)),
    weighed,
    radius_sigma=0.01,  # by calliper
)
print(f"EI is {found.stiffness / wire.base_bending_stiffness:.4f} of the table's", end=" ")
print(f"± {found.stiffness_sigma:.4f}; E {found.modulus / 1e9:.0f} ± ", end="")
print(f"{found.modulus * found.modulus_sigma / 1e9:.0f} GPa, for the radius is known to 1 % only")

# %% One sample of two channels: a curve of contacts
point = np.array([0.18, 0.03, 0.01])  # in the laboratory, standing still
# The calibration's error of gain is the same in every sample, as one of the stiffness would be
estimator = vb.Estimator.of_sensor(contacts, sensor, stiffness_sigma=0.004, felt_above=5.0)
rest = vb.deflect(wire, vb.PointContact(point))
one = estimator(true.read([0.0], np.concatenate([rest.force, rest.moment])[None])[0])
print(one.status)
print(
    f"arc lengths of the samples, mm: {np.sort(one.candidates.arc_length * 1e3).round().tolist()}"
)

# %% The base turns by ± 6° and travels by ± 20 mm: the filter finds the contact
time = np.arange(0.0, 1.0, 0.005)
angle = 0.1 * np.sin(2 * np.pi * time)
turn = np.zeros((time.size, 3, 3))
turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = np.sin(angle), -np.sin(angle), 1.0
base = np.stack([0.02 * np.sin(9.0 * time), 0.0 * time, 0.005 * np.sin(4.0 * time)], axis=-1)
held = vb.deflect(wire, vb.PointContact(np.einsum("tji,tj->ti", turn, point - base)))
stream = true.read(time, np.concatenate([held.force, held.moment], axis=1), seed=2)

follow = vb.ContactFilter(estimator, speed=5e-3)
known = [follow(*sample) for sample in zip(time, stream, turn, base, strict=True)]
error = np.array([np.linalg.norm(k.point - point) for k in known])
sigma = np.array([np.sqrt(np.trace(k.covariance)) for k in known])
for i in (0, 20, 60, len(time) - 1):
    print(
        f"{time[i]:5.2f} s: {error[i] * 1e3:6.1f} mm error, ± {sigma[i] * 1e3:6.1f} mm,"
        f" {len(known[i].points)} hypotheses"
    )

# %% The curve of possible contacts, and how the motion of the base reduces it
with plots.looking():
    figure, (left, right) = plt.subplots(1, 2, figsize=(7.0, 2.6), layout="constrained")
    for line, style, name in (
        (wire.centerline(60), "--", "wire at rest"),
        (rest.centerline(60), "-", "bent by the true contact"),
    ):
        left.plot(*(1e3 * line[:, :2].T), style, color="0.6", linewidth=1.5, label=name)
    order = np.argsort(one.candidates.arc_length)
    candidates = one.candidates.point[order, :2] * 1e3
    left.plot(*candidates.T, "o-", color="#0072b2", ms=3, label="contacts with these two moments")
    left.plot(*(point[:2] * 1e3), "*", color="#d55e00", ms=9, label="true contact")
    left.set(xlabel="x (mm)", ylabel="y (mm)")
    left.set_title("One sample of two moments leaves a curve", loc="left")
    left.legend(loc="upper left")
    right.plot(time, error * 1e3, color="#0072b2", label="error")
    right.plot(time, sigma * 1e3, "--", color="#d55e00", label="predicted error")
    right.set(xlabel="time (s)", ylabel="error of the contact point (mm)", yscale="log")
    right.set_yticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
    late = np.median(error[time > 0.8]) * 1e3
    right.set_title(f"A second of motion of the base leaves {late:.1f} mm", loc="left")
    right.legend()
plots.save(figure, folder / "robot_whisker", ["png"])
