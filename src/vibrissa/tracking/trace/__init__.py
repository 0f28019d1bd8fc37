"""Tracing in the image: lines, whiskers among them, and whiskers followed from frame to frame."""
