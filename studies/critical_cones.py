"""Critical cones over curvature and taper, for the three triplets of the paper.

`python studies/critical_cones.py [FOLDER]` writes the numbers (NetCDF) and the figure; about ten
minutes on two cores. `vibrissa figures MAP --cones FOLDER/critical_cones.nc` draws it as well.
"""

import argparse
from pathlib import Path

from vibrissa import critical_cones, plots

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("folder", nargs="?", type=Path, default="output", help="made if needed")
folder = Path(parser.parse_args().folder)
folder.mkdir(parents=True, exist_ok=True)
found = critical_cones(
    progress=lambda done, total: print(f"\r{done} of {total} whiskers", end="", flush=True)
)
found.to_netcdf(folder / "critical_cones.nc", engine="h5netcdf")
files = plots.save(plots.critical_cones(found), folder / "critical_cones", ("png",))
print(f"\nwrote {folder / 'critical_cones.nc'} and {files[0]}")
