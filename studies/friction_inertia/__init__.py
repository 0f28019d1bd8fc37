"""Validation with friction and inertia, in parts: `studies/validation.py`."""
