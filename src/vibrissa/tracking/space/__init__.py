"""Space: a whisker in 3D from its traces, its shape at rest, and its pose."""
