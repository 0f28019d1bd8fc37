"""Fits of contacts together with shared unknowns: weight, friction, a soft base."""
